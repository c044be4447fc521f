"""`FunctionAction`: an action that is made of a plain function, which is its executor."""

from __future__ import annotations

import inspect
from collections.abc import AsyncGenerator, Awaitable, Callable
from functools import partial, update_wrapper
from typing import Any, Generic, TypeVar, cast

from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar

from fibaction.server.execution.running_goal import RunningGoal
from fibaction.server.functions.report import DONE, Report
from fibaction.server.functions.signature import FunctionSignature
from fibaction.server.goal_handle import GoalHandle
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.returned import Return

CallT = TypeVar("CallT", covariant=True)

MOST_THREADS = 64
"""Goals of one function that run in threads at once, in one event loop; more wait."""


class FunctionAction(Action[GoalT, FeedbackT, ResultT], Generic[GoalT, FeedbackT, ResultT, CallT]):
    """An action that `action` has made of a function, which is its executor.

    `connect` and `call` take it as any action, and `serve` takes it without an `ActionServer`. For
    a server with settings, write `ActionServer(drive, schedule=...)`.

    It can be called as the function that it was, for example by tests: `await drive(3)`.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., CallT],
        *,
        checkpoint: type[Any] | None = None,
        type_name: str = "",
    ) -> None:
        """Make an action of a function; see `action`.

        Raises:
            TypeError: The signature is not that of an executor, or a type cannot be encoded.
            ValueError: The name or the type name breaks the rule for names.
        """
        self._signature = signature = FunctionSignature(function)
        super().__init__(
            name,
            goal=signature.goal,
            feedback=signature.feedback,
            result=signature.result,
            checkpoint=checkpoint,
            type_name=type_name,
        )
        self._function = function
        self._call_text = f"{getattr(function, '__name__', name)}()"
        self._is_async = inspect.iscoroutinefunction(function) or inspect.iscoroutinefunction(
            type(function).__call__
        )
        self._threads: RunVar[CapacityLimiter] = RunVar(f"threads of {name}")
        update_wrapper(self, function)

    def __call__(self, *args: Any, **kwargs: Any) -> CallT:
        """Call the function itself. A `report` that is not given discards the feedback, and one
        that is not a `Report`, such as `print`, is called with it.
        """
        name = self._signature.report
        if not name:
            return self._function(*args, **kwargs)
        bound = inspect.signature(self._function).bind_partial(*args, **kwargs)
        bound.arguments[name] = _as_report(bound.arguments.get(name))
        return self._function(*bound.args, **bound.kwargs)

    def goal_of(self, *args: Any, **kwargs: Any) -> GoalT:
        """Return the goal with which a server calls the function with these arguments.

        Clients need it for a function of several parameters, which are the fields of its goal:

            await call(url, drive, drive.goal_of(3, speed=0.5))

        Raises:
            TypeError: The arguments do not fit the parameters of the function.
        """
        return cast("GoalT", self._signature.goal_of(*args, **kwargs))

    async def executor(
        self, goal: GoalHandle[GoalT]
    ) -> AsyncGenerator[FeedbackT | ResultT | Return[ResultT], None]:
        """Run the function for one goal: the executor of this action.

        A server calls `run` instead. As a generator, it is for executors that iterate over it.
        """
        assert goal.running is not None
        yield Return(await self._returned(goal.running, goal))

    async def run(self, running: RunningGoal, goal: GoalHandle[GoalT]) -> None:
        """Run the function for one goal, in a server: the `Runner` of this function."""
        running.keep_result(await self._returned(running, goal), self._call_text)

    async def _returned(self, running: RunningGoal, goal: GoalHandle[GoalT]) -> ResultT:
        report: Report[FeedbackT] = Report(running)
        try:
            args, kwargs = self._signature.arguments(goal.request, goal, report)
            if self._is_async:
                return await cast("Awaitable[ResultT]", self._function(*args, **kwargs))
            function = partial(self._function, *args, **kwargs)
            return cast("ResultT", await to_thread.run_sync(function, limiter=self._limiter()))
        finally:
            report.close()

    def _limiter(self) -> CapacityLimiter:
        try:
            return self._threads.get()
        except LookupError:
            limiter = CapacityLimiter(MOST_THREADS)
            self._threads.set(limiter)
            return limiter


def _as_report(given: Any) -> Any:
    """Return what a function that is called by itself gets as its report."""
    if isinstance(given, Report):
        return given  # pyright: ignore[reportUnknownVariableType]  # mypy knows it as Report[Any]

    def report(feedback: object) -> Awaitable[None]:
        if given is not None:
            answer = given(feedback)
            if isinstance(answer, Awaitable):
                return cast("Awaitable[None]", answer)
        return DONE

    return report
