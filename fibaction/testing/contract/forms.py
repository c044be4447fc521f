"""The two forms of an executor: the generator, and a function that does the same by a report."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from fibaction import FunctionAction, GoalHandle, Report, action
from fibaction.server.execution.executor import Executor
from fibaction.testing.contract.executors import Items
from fibaction.testing.contract.fibonacci import Feedback, Goal, Result

Generator: TypeAlias = Callable[[GoalHandle[Goal]], Items]
Form: TypeAlias = Callable[[Generator], Executor[Goal, Feedback, Result]]
"""Makes an executor of a generator, in one of the forms."""

OF_GENERATORS = {
    "ends_without_a_result",
    "yields_after_the_result",
    "yields_two_results",
    "yields_a_wrong_type",
    "raises_after_the_result",
    "ignores_that_it_is_closed",
    "is_no_generator",
    "returns_its_feedback",
}
"""The executors that break rules which only a generator can break."""


def as_generator(executor: Generator) -> Executor[Goal, Feedback, Result]:
    """Return the executor itself."""
    return executor


def as_function(executor: Generator) -> Executor[Goal, Feedback, Result]:
    """Return an executor of the same steps that is made of a function: it reports what the
    generator yields, and returns its result.
    """

    @action("fibonacci")
    async def fibonacci(goal: GoalHandle[Goal], report: Report[Feedback]) -> Result:
        items = executor(goal)
        results: list[Result] = []
        step = anext(items)
        try:
            while True:
                try:
                    item = await step
                except StopAsyncIteration:
                    break
                except BaseException:
                    del step  # it may reference the exception, which references this frame
                    raise
                if isinstance(item, Result):
                    results.append(item)
                    step = anext(items)
                    continue
                try:
                    await report(item)
                except BaseException as exc:
                    step = items.athrow(exc)
                else:
                    step = anext(items)
        finally:
            await items.aclose()
        return results.pop()

    assert isinstance(fibonacci, FunctionAction)
    return fibonacci.executor


FORMS: dict[str, Form] = {"generator": as_generator, "function": as_function}
