"""The action of the tests, Fibonacci, and its executors: one that tests let go, and some that fail.

They have two forms: the generator, and a function that does the same by a report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncGenerator, Callable
from typing import TypeAlias, cast

import anyio
import msgspec

from fibaction import (
    Action,
    FunctionAction,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    Report,
    action,
)
from fibaction.border.abc import StatusStream
from fibaction.server.execution.executor import Executor


class Goal(msgspec.Struct):
    order: int


class Feedback(msgspec.Struct):
    partial_sequence: list[int]


class Result(msgspec.Struct):
    sequence: list[int]


FIBONACCI = Action(
    "fibonacci",
    goal=Goal,
    feedback=Feedback,
    result=Result,
    type_name="arduinobot_msgs/action/Fibonacci",
)


async def fibonacci(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    """Compute at once, with one feedback per term after the first two."""
    sequence = [0, 1]
    while len(sequence) <= goal.request.order:
        sequence.append(sequence[-1] + sequence[-2])
        yield Feedback(sequence)
    yield Result(sequence[: goal.request.order + 1])


Items = AsyncGenerator[Feedback | Result, None]


class Steps:
    """An executor that yields feedback up to its order, and then waits until it is let go."""

    def __init__(self, *, go: bool = False) -> None:
        self.runs: Counter[GoalID] = Counter()
        self.deadlines: list[float] = []
        self.yielded = 0
        self.ended_as: list[GoalStatus] = []
        self.began, self.canceled, self.go = anyio.Event(), anyio.Event(), anyio.Event()
        self.clean: anyio.Event | None = None
        """The event that its clean-up waits for, if there is one."""
        if go:
            self.go.set()

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        self.runs[goal.goal_id] += 1
        self.deadlines.append(goal.deadline - anyio.current_time())
        self.began.set()
        try:
            for self.yielded in range(1, goal.request.order + 1):
                yield Feedback([self.yielded])
            await self.go.wait()
        except anyio.get_cancelled_exc_class():
            self.canceled.set()
            if self.clean is not None:
                await self.clean.wait()
            raise
        finally:
            self.ended_as.append(goal.status)
        yield Result([goal.request.order])


class Undecided:
    """An `on_cancel` or `on_goal` that says that it was asked, and agrees when it is told to."""

    def __init__(self) -> None:
        self.asked, self.decide = anyio.Event(), anyio.Event()

    async def __call__(self, goal: object) -> None:
        self.asked.set()
        await self.decide.wait()


async def next_with(statuses: StatusStream, status: GoalStatus) -> GoalInfo:
    """Return the next goal that is told with a status."""
    while (info := await statuses.receive()) is not None:
        if info.status is status:
            return info
    raise AssertionError(f"no {status.name} came")


async def ends_without_a_result(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])


async def yields_after_the_result(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    yield Feedback([2])


async def yields_two_results(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    yield Result([2])


async def yields_a_wrong_type(goal: GoalHandle[Goal]) -> Items:
    yield cast("Feedback", {"partial_sequence": [1]})


async def yields_what_cannot_be_encoded(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([cast("int", object())])


async def raises_before_the_first_yield(goal: GoalHandle[Goal]) -> Items:
    raise ValueError("no such arm")
    yield Result([])


async def raises_after_feedback(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    raise ValueError("the arm is stuck")


async def raises_after_the_result(goal: GoalHandle[Goal]) -> Items:
    yield Result([1])
    raise ValueError("the gripper does not open")


async def raises_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    async with anyio.create_task_group():
        raise ValueError("inside")
    yield Result([])


async def raises_twice_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    raise ExceptionGroup("two things", [ValueError("a"), KeyError("b")])
    yield Result([])


class Mute(Exception):
    """An error whose `str()` fails."""

    def __str__(self) -> str:
        raise LookupError("no words")


async def raises_what_cannot_say_what_it_is(goal: GoalHandle[Goal]) -> Items:
    raise Mute
    yield Result([])


async def aborts_with_an_error_as_its_reason(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted(cast("str", ValueError("too heavy")), result=Result([1]))
    yield Result([])


async def raises_while_it_is_closed(goal: GoalHandle[Goal]) -> Items:
    try:
        yield cast("Feedback", None)
    finally:
        raise ValueError("in finally")


async def ignores_that_it_is_closed(goal: GoalHandle[Goal]) -> Items:
    try:
        yield cast("Feedback", None)
    finally:
        yield Feedback([1])


async def aborts_with_a_part(goal: GoalHandle[Goal]) -> Items:
    yield Feedback([1])
    raise GoalAborted("the object is too heavy", result=Result([1]))


async def aborts_in_a_task_group(goal: GoalHandle[Goal]) -> Items:
    async with anyio.create_task_group():
        raise GoalAborted("the object is too heavy", result=Result([1]))
    yield Result([])


async def aborts_with_a_wrong_part(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted("the object is too heavy", result=[1])
    yield Result([])


async def aborts_with_what_cannot_be_encoded(goal: GoalHandle[Goal]) -> Items:
    raise GoalAborted("the object is too heavy", result=Result([2**70]))
    yield Result([])


async def says_canceled_though_nobody_asked(goal: GoalHandle[Goal]) -> Items:
    raise GoalCanceled(result=Result([1]))
    yield Result([])


async def says_canceled_with_a_reason(goal: GoalHandle[Goal]) -> Items:
    raise GoalCanceled("no light")
    yield Result([])


async def raises_what_only_python_does(goal: GoalHandle[Goal]) -> Items:
    raise GeneratorExit("by hand")
    yield Result([])


def is_no_generator(goal: GoalHandle[Goal]) -> Items:
    async def forgot_to_yield() -> Result:
        return Result([])

    return cast("Items", forgot_to_yield())


def returns_its_feedback(goal: GoalHandle[Goal]) -> Items:
    return cast("Items", [Feedback([goal.request.order])])


def raises_instead_of_making_one(goal: GoalHandle[Goal]) -> Items:
    raise ValueError("at once")


WRONG = "the executor is wrong: "
UNENCODABLE = "Encoding objects of type object is unsupported"

ABORTED: list[tuple[Callable[[GoalHandle[Goal]], Items], str, list[int] | None]] = [
    (ends_without_a_result, WRONG + "it ended without yielding a result", None),
    (yields_after_the_result, WRONG + "it yielded a Feedback after its result", [1]),
    (yields_two_results, WRONG + "it yielded a Result after its result", [1]),
    (
        yields_a_wrong_type,
        WRONG + "it yielded a dict, which is neither feedback (Feedback) nor a result (Result)",
        None,
    ),
    (yields_what_cannot_be_encoded, f"TypeError: {UNENCODABLE}", None),
    (raises_before_the_first_yield, "ValueError: no such arm", None),
    (raises_after_feedback, "ValueError: the arm is stuck", None),
    (raises_what_cannot_say_what_it_is, "Mute", None),
    (aborts_with_an_error_as_its_reason, "too heavy", [1]),
    (raises_after_the_result, "ValueError: the gripper does not open", [1]),
    (raises_in_a_task_group, "ValueError: inside", None),
    (raises_twice_in_a_task_group, "ExceptionGroup: two things (2 sub-exceptions)", None),
    (raises_while_it_is_closed, "ValueError: in finally", None),
    (ignores_that_it_is_closed, "RuntimeError: async generator ignored GeneratorExit", None),
    (aborts_with_a_part, "the object is too heavy", [1]),
    (aborts_in_a_task_group, "the object is too heavy", [1]),
    (
        aborts_with_a_wrong_part,
        "the object is too heavy (its result is left out: a list is not Result)",
        None,
    ),
    (
        aborts_with_what_cannot_be_encoded,
        (
            "OverflowError: a whole number of more than 64 bits cannot be sent: send it as text"
            " - at `$.sequence[0]`"
        ),
        None,
    ),
    (
        says_canceled_though_nobody_asked,
        "its code ended as canceled, but no cancel was requested",
        [1],
    ),
    (says_canceled_with_a_reason, "no light", None),
    (raises_what_only_python_does, "GeneratorExit: by hand", None),
    (is_no_generator, WRONG + "it is not an async generator: it returned a coroutine", None),
    (returns_its_feedback, WRONG + "it is not an async generator: it returned a list", None),
    (raises_instead_of_making_one, "ValueError: at once", None),
]
"""(executor, reason, partial result)"""


# Forms

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
