"""`ActionClient`: send goals to an endpoint, follow and cancel them.

A client calls the methods of an `Endpoint`, which may be a server in the same process or the client
half of a transport. The client adds the types of the `Action`: it encodes goals, and decodes
feedback and results. It keeps no state about goals but one table, `_blocks`, in their order.

Sending: `send_goal` returns a `SendingGoal`, which is both awaitable and an async context manager.
Nothing is sent before one of the two begins. If the task is canceled while it waits for the answer,
the goal may have been accepted already; so the client cancels it by its ID, which it made itself.

Following and leaving a goal: see `goal`. Timeouts and retries: see `attempts`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Mapping
from contextlib import AbstractAsyncContextManager
from operator import index
from typing import Any, Generic, TypeVar, Unpack, cast, overload

import anyio
from anyio import get_cancelled_exc_class
from msgspec.structs import replace

from fibaction._runtime.async_only import OwnThread
from fibaction.border.abc import Endpoint, GoalRequest, GoalStream
from fibaction.border.watchers import NO_SPAN, GoalTracer
from fibaction.client.attempts import Attempts, cancel_left
from fibaction.client.events import Events, events_of
from fibaction.client.goal import Blocks, ClientGoal, SendingGoal, leave_blocks
from fibaction.client.goal_step import SendingStep, StepEndpoint
from fibaction.client.kept_connection import KeptEndpoint
from fibaction.client.options import (
    CALL_OPTIONS,
    GOAL_OPTIONS,
    CallOrStepOptions,
    GoalOrStepOptions,
    goal_of,
)
from fibaction.client.retry import Retry
from fibaction.types.action import NO_VALUE, Action, Codec, FeedbackT, GoalT, ResultT
from fibaction.types.arguments import Arguments, CalledAction, HasAction, P, TakesNone, TakesOne
from fibaction.words.errors import ActionError, ServerNotFound
from fibaction.words.goal_steps import GoalStep
from fibaction.words.goals import CancelAnswer, GoalID, GoalInfo
from fibaction.words.meta import NO_META, with_labels
from fibaction.words.plain_data import check_is_number

SOON = 0.5
"""Seconds to find out why an action was not served."""
WAIT_HINT = ", or wait for it with wait_for_server()"

OneT = TypeVar("OneT")


class ActionClient(Generic[GoalT, FeedbackT, ResultT]):
    """A client of one action at one endpoint, which need not be closed.

    It belongs to one event loop: in another thread, the methods that wait, and those of its
    goals, raise `RuntimeError`.

    For example:

        async with connect("tcp://127.0.0.1:7400", DRIVE) as client:
            print(await client.call(3, on_feedback=print))
    """

    def __init__(
        self,
        endpoint: Endpoint,
        action: Action[GoalT, FeedbackT, ResultT],
        blocks: Blocks | None = None,
        *,
        tracing: GoalTracer | None = None,
    ) -> None:
        """Make a client; `blocks` are the open blocks of its connection, if it has one. `tracing`
        makes a span for each goal that is sent.
        """
        self.endpoint = endpoint
        """The endpoint that the goals are sent to."""
        self.action = action
        self._takes_value = type(action) is Action  # and not the arguments of a function
        self._thread = OwnThread()
        self._blocks: Blocks = {} if blocks is None else blocks
        self._tracing = tracing

    # For type checkers: the arguments of a function alone, or the options alone, for a function
    # without parameters and for one with defaults; or one argument and the options; None; or any
    # other goal.

    @overload
    def send_goal(
        self: ActionClient[Arguments[P], FeedbackT, ResultT], /, *args: P.args, **kwargs: P.kwargs
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: ActionClient[Arguments[[]], FeedbackT, ResultT],
        /,
        **options: Unpack[GoalOrStepOptions],
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[TakesNone[FeedbackT, ResultT]], /, **options: Unpack[GoalOrStepOptions]
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[TakesOne[OneT, FeedbackT, ResultT]],
        first: OneT,
        /,
        **options: Unpack[GoalOrStepOptions],
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self: HasAction[CalledAction[None, FeedbackT, ResultT]],
        goal: None = None,
        /,
        **options: Unpack[GoalOrStepOptions],
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    @overload
    def send_goal(
        self, goal: GoalT, /, **options: Unpack[GoalOrStepOptions]
    ) -> SendingGoal[FeedbackT, ResultT]: ...
    def send_goal(self, /, *args: Any, **given: Any) -> SendingGoal[Any, Any]:
        """Send a goal: **`async with send_goal` cancels, `await send_goal` does not.**

        The end of the block of `async with` cancels the goal if it has not ended, without waiting
        for the executor's clean-up. After `goal = await client.send_goal(...)` it runs to its end.
        Both return a `ClientGoal` as soon as the server has accepted the goal; a cancellation of
        the task before that cancels it. An action without a goal takes `send_goal()`. `goal_id`
        serves to send the same goal again after its answer was lost.

        `timeout` is the number of seconds for the goal as a whole, from here to its end. Then each
        wait for the goal ends: for its acceptance, its feedback, its outcome. It cancels the goal,
        waits some seconds at most for the answer to that, and raises `GoalTimeout`. A goal that no
        task waits for is not canceled. The executor finds the time in `GoalHandle.deadline`.

        `labels` are in lists of goals, to find it again; a trace goes with it as far as both fit.
        `step`, for blocks only, makes it the child of an executor's goal: see `GoalHandle.step`.

        Raises:
            GoalTimeout: The server did not accept the goal within `timeout` seconds.
            GoalRejected: The server did not accept the goal; `reason` says why.
            ServerNotFound: This action is not served.
            ConnectionLost: The connection ended before the answer.
            AuthenticationFailed: This client lacks the permission.
            InvalidMessage: The goal or its labels are too large to be sent; nothing was sent.
            ProtocolError: The server sent an invalid message, which ended the connection.
            TypeError, ValueError, OverflowError, RecursionError: The goal cannot be encoded: see
                `Codec.encode`.
            TypeError: `goal_id` is not a `GoalID`, or is given together with a `step`; or there is
                no goal, and the action needs one.
            ValueError: `timeout` is not more than 0; a label has a key of a trace or of a parent;
                or, from the block, the step was taken before.
        """
        if self._takes_value and len(args) == 1 and given.keys() <= GOAL_OPTIONS:
            goal = args[0]
        else:
            goal = goal_of(self.action, args, given, GOAL_OPTIONS)
        options: GoalOrStepOptions = cast("Any", given)
        chosen, step = options.get("goal_id"), options.get("step")
        timeout, labels = options.get("timeout"), options.get("labels")
        if step is not None:
            if chosen is not None:
                raise TypeError("a step has the ID of its goal: give goal_id or step, not both")
            return self._sending_step(goal, step, timeout, None, labels=labels)
        goal_id = GoalID.random() if chosen is None else GoalID.of(chosen)
        attempts = None if timeout is None else Attempts(self.endpoint, goal_id, timeout, None)
        sending = self._send(self.endpoint, goal, goal_id, attempts, labels=labels)
        return SendingGoal(self.endpoint, goal_id, sending, self._blocks, attempts)

    @overload
    async def call(
        self: ActionClient[Arguments[P], FeedbackT, ResultT], /, *args: P.args, **kwargs: P.kwargs
    ) -> ResultT: ...
    @overload
    async def call(
        self: ActionClient[Arguments[[]], FeedbackT, ResultT],
        /,
        **options: Unpack[CallOrStepOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    async def call(
        self: HasAction[TakesNone[FeedbackT, ResultT]],
        /,
        **options: Unpack[CallOrStepOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    async def call(
        self: HasAction[TakesOne[OneT, FeedbackT, ResultT]],
        first: OneT,
        /,
        **options: Unpack[CallOrStepOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    async def call(
        self: HasAction[CalledAction[None, FeedbackT, ResultT]],
        goal: None = None,
        /,
        **options: Unpack[CallOrStepOptions[FeedbackT]],
    ) -> ResultT: ...
    @overload
    async def call(
        self, goal: GoalT, /, **options: Unpack[CallOrStepOptions[FeedbackT]]
    ) -> ResultT: ...
    async def call(self, /, *args: Any, **given: Any) -> Any:
        """Send a goal, and return its result.

        `on_feedback`, sync or async, is called with each feedback. A cancellation of the calling
        task, or an exception of `on_feedback`, cancels the goal. If feedback was lost, for example
        with a connection, the number of lost messages is logged as a warning of
        `fibaction.client`, unless the server's policy is `feedback="latest"`.

        `timeout` is the number of seconds for all of it, from here to the result, all attempts
        included; then the goal is canceled. `on_feedback` is not interrupted: the time is checked
        again when it returns.

        With `retry`, another attempt follows an error after which it is safe: see `Retry`. The goal
        keeps its ID, and runs once, as long as the server remembers it. Each attempt after the
        first is logged as information of `fibaction.client`.

        `labels` are those of `send_goal`. For `step`, see `GoalHandle.step`.

        Raises:
            GoalTimeout: It took longer than `timeout` seconds.
            GoalRejected, ServerNotFound, ConnectionLost, AuthenticationFailed, ProtocolError,
                TypeError, ValueError, OverflowError, RecursionError: As for `send_goal`.
            GoalAborted, GoalCanceled, UnknownGoal, TransportError: As for `ClientGoal.result`.
            ValueError: `timeout` is not more than 0, or the step was taken before.
            TypeError: `retry` is not a `Retry`.
        """
        if self._takes_value and len(args) == 1 and given.keys() <= CALL_OPTIONS:
            goal = args[0]
        else:
            goal = goal_of(self.action, args, given, CALL_OPTIONS)
        options: CallOrStepOptions[FeedbackT] = cast("Any", given)
        on_feedback, step = options.get("on_feedback"), options.get("step")
        timeout, retry = options.get("timeout"), options.get("retry")
        labels, follow = options.get("labels"), on_feedback is not None
        block: SendingGoal[FeedbackT, ResultT]
        if step is not None:
            block = self._sending_step(goal, step, timeout, retry, labels=labels, feedback=follow)
        else:
            goal_id, attempts = GoalID.random(), None
            if timeout is not None or retry is not None:
                attempts = Attempts(self.endpoint, goal_id, timeout, retry)
            sending = self._send(
                self.endpoint, goal, goal_id, attempts, feedback=follow, labels=labels
            )
            block = SendingGoal(self.endpoint, goal_id, sending, self._blocks, attempts)
        async with block as sent:
            if on_feedback is not None:
                async for feedback in sent.feedback:
                    answer = on_feedback(feedback)
                    if answer is not None and isinstance(answer, Awaitable):
                        await answer
                sent.feedback.warn_of_loss()
            return await sent.result()

    async def attach(
        self, goal_id: GoalID | str, *, after: int | None = None, attempt: int = 1
    ) -> ClientGoal[FeedbackT, ResultT]:
        """Follow a goal that any client sent: its feedback from now on, and its result.

        With `after`, the feedback begins after that number, as far back as the server remembers:
        `goal.feedback.number` is the number of the feedback that was read last. `attempt` is the
        attempt in which that number counts, `goal.feedback.attempt`; if the server has run the goal
        again since, the feedback begins with the first of the new attempt.

        Raises:
            UnknownGoal: The server has no such goal.
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError, ValueError: `goal_id` is neither a `GoalID` nor its text, or a number is not
                a whole one.
        """
        goal_id = GoalID.of(goal_id)
        after = None if after is None else index(after)
        self._thread.check()
        stream = await self.endpoint.feedback(goal_id, after=after, attempt=index(attempt))
        return ClientGoal(self.endpoint, self.action, stream, self._thread)

    async def cancel_goals(
        self, goal_id: GoalID | str | None = None, *, before: int | None = None
    ) -> CancelAnswer:
        """Ask the server to cancel goals of any clients.

        Without arguments, this means all goals; with `before`, those accepted at or before that
        stamp; with `goal_id`, that goal; with both, that goal and those.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
            TypeError, ValueError: `goal_id` is neither a `GoalID` nor its text, or `before` is not
                a whole number.
        """
        if goal_id is not None:
            goal_id = GoalID.of(goal_id)
        before = None if before is None else index(before)
        self._thread.check()
        return await self.endpoint.cancel_goals(goal_id, before)

    async def goals(self, *, results: bool = False) -> list[GoalInfo]:
        """Return every goal that the server knows: those that have ended, then the active ones.

        With `results`, fetch the result of each goal that has ended, too, by one request each.

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        self._thread.check()
        with await self.endpoint.status() as statuses:
            infos = await statuses.listed()
        if results:
            infos = [await with_result(self.endpoint, self.action.result, one) for one in infos]
        return infos

    def events(self, *, feedback: bool = True) -> AbstractAsyncContextManager[Events[FeedbackT]]:
        """Return a block whose value is an iterator over all events of the action's goals.

        The events are first every goal that the server knows, then each change of a status, and,
        with `feedback`, the feedback of all goals, of new ones from the beginning, as far back as
        the server remembers. The end of a goal comes after its feedback.

            async with client.events() as events:
                async for event in events:
                    ...

        Raises:
            ServerNotFound, ConnectionLost, AuthenticationFailed: As for `send_goal`.
            TransportError: As for `ClientGoal.cancel`.
        """
        return events_of(self.endpoint, self.action.feedback, self._thread, feedback=feedback)

    async def wait_for_server(self, timeout: float | None = None) -> None:
        """Wait until the action is served.

        Raises:
            ServerNotFound: It was not served within `timeout` seconds (None: no limit).
            TransportError: The connection ended for good, or the server does not answer.
        """
        self._thread.check()
        if timeout is not None:
            check_is_number("timeout", timeout)
        with anyio.move_on_after(timeout):
            return await self.endpoint.wait_for_server()
        what = f"the action {self.action.name!r} was not served within {timeout:g} s"
        with anyio.move_on_after(SOON):  # most endpoints know at once what is missing
            try:
                (await self.endpoint.status()).close()
            except ActionError as exc:
                raise ServerNotFound(f"{what}: {exc}".partition(WAIT_HINT)[0]) from exc
        raise ServerNotFound(what)

    async def leave(self) -> None:
        """Cancel the goals of `call`, and of blocks of `send_goal`, that have not ended.

        The end of the block of `connect` calls this, before it closes the connection.
        """
        await leave_blocks(self._blocks)

    async def aclose(self) -> None:
        """Close the connection that `await connect(...)` has opened, from any task.

        Goals of `call`, and of blocks of `send_goal`, that have not ended are canceled first.
        Closing twice does nothing.

        Raises:
            RuntimeError: This client was not made by `await connect(...)`.
        """
        if not isinstance(self.endpoint, KeptEndpoint):
            raise RuntimeError(
                "this client need not be closed: the block of `async with connect(...)` closes its"
                " connection, and aclose() is for `client = await connect(...)`"
            )
        await self.endpoint.connection.aclose()

    def _sending_step(
        self,
        goal: GoalT,
        step: GoalStep,
        timeout: float | None,
        retry: Retry | None,
        *,
        labels: Mapping[str, str] | None,
        feedback: bool = True,
    ) -> SendingStep[FeedbackT, ResultT]:
        """Return the child to be sent as a step."""
        if not isinstance(step, GoalStep):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(
                f"a step is made by a goal, as `goal.step('drive')`; {step!r} is not one"
            )
        goal_id = step.child_id(self.action.name)
        endpoint = StepEndpoint(self.endpoint, step, goal_id)
        attempts = None
        if timeout is not None or retry is not None:
            attempts = Attempts(endpoint, goal_id, timeout, retry)
        sending = self._send(
            endpoint, goal, goal_id, attempts, feedback=feedback, labels=labels, step=step
        )
        return SendingStep(endpoint, goal_id, sending, self._blocks, attempts)

    async def _send(
        self,
        endpoint: Endpoint,
        goal: GoalT,
        goal_id: GoalID,
        attempts: Attempts | None,
        *,
        feedback: bool = True,
        labels: Mapping[str, str] | None = None,
        step: GoalStep | None = None,
    ) -> ClientGoal[FeedbackT, ResultT]:
        self._thread.check()
        action = self.action
        payload = action.default_goal() if goal is NO_VALUE else action.goal.encode(goal)
        span = NO_SPAN
        if self._tracing is not None:
            parent = None if step is None else step.parent
            span = self._tracing.sending(action.name, goal_id, parent)
        meta = with_labels(labels, span.meta or NO_META) if labels else span.meta
        request = GoalRequest(goal_id, payload, feedback, meta=meta, checked=action.goal.is_typed)
        try:
            if attempts is not None:
                stream = await attempts.send(request)
            else:
                offered = endpoint.offer_goal(request)
                stream = offered if isinstance(offered, GoalStream) else await offered
        except BaseException as exc:
            span.failed(exc)
            if attempts is None and isinstance(exc, get_cancelled_exc_class()):
                # The server may have accepted the goal, and it would run without a client.
                await cancel_left(endpoint, goal_id)
            raise
        span.accepted(stream)
        return ClientGoal(self.endpoint, self.action, stream, self._thread, attempts, span)

    # Python warns with this name if a goal is never awaited, and so never sent.
    _send.__qualname__ = "ActionClient.send_goal"

    def __repr__(self) -> str:
        return f"<ActionClient of {self.action!r}>"


async def with_result(endpoint: Endpoint, codec: Codec[ResultT], info: GoalInfo) -> GoalInfo:
    """Return a goal with its result, and with its whole reason, if it has ended.

    A goal that the server has forgotten meanwhile stays as it is. If the result cannot be read, the
    reason says so.

    Raises:
        TransportError, ProtocolError: As for `Endpoint.get_result`.
    """
    if not info.status.is_terminal:
        return info
    outcome = await endpoint.get_result(info.goal_id)
    if not outcome.status.is_terminal:
        return info
    outcome = outcome.readable(codec.decode)
    return replace(info, result=outcome.result, reason=outcome.reason)
