"""Helpers for tests: run an executor without a transport, or a client without a robot.

They use the real server and the real client; only the transport is left out.
"""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator, Sequence
from typing import Any, Concatenate, Generic, TypeAlias, TypedDict, TypeVar, Unpack, cast, overload

import anyio
import msgspec

from fibaction.client.client import ActionClient
from fibaction.client.options import goal_of
from fibaction.server import ActionServer, Executor, FunctionAction, GoalHandle
from fibaction.server.functions.executor_check import executor_of
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import Arguments, P, TakesArguments, TakesNone, TakesOne
from fibaction.words.errors import GoalRejected, ProtocolError
from fibaction.words.goals import Outcome

OneT = TypeVar("OneT")


class Trial(msgspec.Struct, Generic[FeedbackT, ResultT], frozen=True):
    """The outcome and the feedback of one goal that `run_executor` ran."""

    outcome: Outcome[ResultT]
    feedback: list[FeedbackT]
    """All feedback of the goal, in order."""


class TrialOptions(TypedDict, total=False):
    """The options of `run_executor`, which describes them."""

    cancel_after: int | None
    interrupt_on_cancel: bool
    timeout: float | None


@overload
async def run_executor(
    action: TakesArguments[P, FeedbackT, ResultT], /, *args: P.args, **kwargs: P.kwargs
) -> Trial[FeedbackT, ResultT]: ...
@overload
async def run_executor(
    action: TakesNone[FeedbackT, ResultT], /, **options: Unpack[TrialOptions]
) -> Trial[FeedbackT, ResultT]: ...
@overload
async def run_executor(
    action: TakesOne[OneT, FeedbackT, ResultT], first: OneT, /, **options: Unpack[TrialOptions]
) -> Trial[FeedbackT, ResultT]: ...
@overload
async def run_executor(
    action: FunctionAction[Concatenate[OneT, P], FeedbackT, ResultT, Any],
    first: OneT,
    /,
    **options: Unpack[TrialOptions],
) -> Trial[FeedbackT, ResultT]: ...
@overload
async def run_executor(
    action: Action[GoalT, FeedbackT, ResultT],
    executor: Executor[GoalT, FeedbackT, ResultT],
    goal: GoalT,
    /,
    **options: Unpack[TrialOptions],
) -> Trial[FeedbackT, ResultT]: ...
@overload
async def run_executor(
    action: FunctionAction[P, FeedbackT, ResultT, Any],
    goal: Arguments[P],
    /,
    **options: Unpack[TrialOptions],
) -> Trial[FeedbackT, ResultT]: ...
async def run_executor(action: Any, /, *args: Any, **given: Any) -> Trial[Any, Any]:
    """Run an executor with a goal, and return its feedback and its outcome.

        await run_executor(drive, 3)  # a function with its arguments
        await run_executor(DRIVE, drive, 3)  # a generator of another action, with a goal

    With `cancel_after`, the goal is canceled when that many feedback messages have been yielded,
    exactly at that `yield`; 0 cancels the goal before the executor starts, which then never runs.

    Raises:
        TimeoutError: The executor did not end within `timeout` seconds, 5 if it is not given.
        ProtocolError: It yielded feedback or a result that is not of its type; the text names the
            field. A server does not check this; its clients raise this error.
        GoalRejected: The goal is not of its type.
    """
    if not issubclass(type(action), Action):  # `isinstance` would leave its types unknown
        raise TypeError(f"run_executor() takes an action, not {action!r}: make one with @action")
    executor: Any = None
    is_function = issubclass(type(action), FunctionAction)
    if args and callable(args[0]) and not (is_function and action.goal.holds(args[0])):
        executor, args = args[0], args[1:]
    goal = goal_of(action, args, given, frozenset(TrialOptions.__annotations__))
    options: TrialOptions = cast("Any", given)
    cancel_after, timeout = options.get("cancel_after"), options.get("timeout")
    limit = 5.0 if timeout is None else timeout
    feedback: list[Any] = []
    # A window of one makes the executor wait at each `yield` until the feedback has been read.
    server = ActionServer(
        action,
        executor or executor_of(action),
        feedback_window=1,
        stall_timeout=math.inf,
        interrupt_on_cancel=options.get("interrupt_on_cancel", True),
    )
    async with server:
        with anyio.move_on_after(limit):
            try:
                async with ActionClient(server, action).send_goal(goal) as sent:
                    if cancel_after == 0:
                        await sent.cancel()
                    async for item in sent.feedback:
                        feedback.append(item)
                        if len(feedback) == cancel_after:
                            await sent.cancel()
                    return Trial(await sent.outcome(), feedback)
            except ProtocolError as exc:
                subject = "the executor" if executor else f"the function of {action.name!r}"
                raise ProtocolError(f"{subject} is wrong: {exc}") from exc
        raise TimeoutError(f"the goal of action {action.name!r} has not ended within {limit:g} s")


Step: TypeAlias = FeedbackT | ResultT | Exception | anyio.Event
"""One step of a script: feedback or the result to yield, an exception to raise (a `GoalRejected` as
the first step rejects the goal), or an event to wait for."""


class ScriptedServer(ActionServer[GoalT, FeedbackT, ResultT]):
    """A server that plays scripts, for tests of clients.

    The first goal gets the first script, the second goal the second; the last script is played for
    all further goals. A script is a sequence of steps: see `Step`. For example, an event that is
    never set keeps a goal running until it is canceled.
    """

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        *scripts: Sequence[Step[FeedbackT, ResultT]],
    ) -> None:
        """Set up a server with scripts; nothing runs yet.

        Raises:
            ValueError: The scripts are missing.
        """
        if not scripts:
            raise ValueError("a ScriptedServer needs at least one script")
        super().__init__(action, self._play, on_goal=self._choose)
        self.received: list[GoalT] = []
        """The goals that were sent, rejected ones included, in order."""
        self._scripts = scripts
        self._chosen: list[tuple[GoalT, Sequence[Step[FeedbackT, ResultT]]]] = []

    def _choose(self, goal: GoalT) -> None:
        script = self._scripts[min(len(self.received), len(self._scripts) - 1)]
        self.received.append(goal)
        if script and isinstance(script[0], GoalRejected):
            raise script[0]
        self._chosen.append((goal, script))

    async def _play(self, handle: GoalHandle[GoalT]) -> AsyncGenerator[FeedbackT | ResultT, None]:
        # By identity, since executors need not start in the order in which goals were accepted.
        place = next(i for i, (goal, _) in enumerate(self._chosen) if goal is handle.request)
        for step in self._chosen.pop(place)[1]:
            if isinstance(step, anyio.Event):
                await step.wait()
            elif isinstance(step, Exception):
                raise step
            else:
                yield step
