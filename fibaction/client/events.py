"""All events of the goals of one action, merged into one stream, for logs and monitors.

Theory of operation
-------------------

An endpoint has two kinds of streams: one with the statuses of all goals, and one per goal with its
feedback. `events_of` merges them. One task follows the statuses, and for each active goal a further
task follows its feedback; all of them send into one memory stream of BUFFER events, which the
reader of `Events` takes from. If the reader is slow, the tasks wait, and the streams behind them
drop the oldest, as they do for each slow follower. None of them holds an executor.

The feedback of a goal that is new begins at its first message; that of a goal which the server knew
before begins with the next one.

Order: a goal's end must come after its feedback, but the two arrive by different streams, and the
end usually arrives first. So `_late` has an entry for each goal whose feedback is followed:

- a list, while the feedback is read: an end that arrives meanwhile is appended to it, and is sent
  when the feedback is at its end; then the entry is removed;
- None, after the feedback has ended and before the status stream has reported the end: the entry
  prevents that a further status, such as CANCELING, has the goal followed a second time; the end
  removes it.

A goal may be reported after its end by one more status, UNKNOWN, when the server forgets it; this
waits in the same list, so it also comes after the feedback.

Errors: an error of a stream is sent as an event, and `Events` raises it to the reader. An unknown
goal is not an error: it ended and was forgotten before its feedback was asked for.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from time import time_ns
from typing import Generic, TypeAlias

import anyio
import msgspec
from anyio.abc import TaskGroup
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream

from fibaction._runtime.async_only import AsyncItems, OwnThread
from fibaction.border.abc import Endpoint, StatusStream
from fibaction.border.event_loop import Background
from fibaction.types.action import Codec, FeedbackT
from fibaction.words.errors import ActionError, UnknownGoal
from fibaction.words.goals import GoalID, GoalInfo

BUFFER = 64
"""Events that wait for the reader; the streams behind have windows of their own."""


class GoalFeedback(msgspec.Struct, Generic[FeedbackT], frozen=True):
    """One feedback message of one of the goals."""

    goal_id: GoalID
    number: int
    """The number of the message among the feedback of its attempt: 1, 2, 3 and so on; a gap shows
    that messages were missed."""
    feedback: FeedbackT
    attempt: int = 1
    """The attempt at the goal that the feedback is of, from 1: see `ClientGoal.attempt`."""
    at: int = msgspec.field(default_factory=time_ns)
    """The time at which the executor reported it: see `FeedbackReader.at`."""


class Events(AsyncItems, Generic[FeedbackT]):
    """The events of all goals, for `async for`, which ends when the server stops or the block of
    the events is left.

    For example:

        async with client.events() as events:
            async for event in events:
                print(event)
    """

    read_by = "async for event in events:"

    def __init__(
        self,
        stream: MemoryObjectReceiveStream[GoalInfo | GoalFeedback[FeedbackT] | ActionError],
        statuses: StatusStream,
    ) -> None:
        self._stream = stream
        self._statuses = statuses

    @property
    def dropped(self) -> int:
        """The number of status changes that were missed, because they were not read in time."""
        return self._statuses.dropped

    def __aiter__(self) -> Events[FeedbackT]:
        return self

    async def __anext__(self) -> GoalInfo | GoalFeedback[FeedbackT]:
        """Return the next event.

        Raises:
            StopAsyncIteration: The server has stopped, or the block of the events was left.
            ConnectionLost: The connection ended.
            TransportError: The server cannot send the rest, or this client lacks the permission.
            ProtocolError: The feedback is not of its type.
        """
        try:
            event = await self._stream.__anext__()
        except anyio.ClosedResourceError:  # the block was left; a task that waits here ends, too
            raise StopAsyncIteration from None
        if isinstance(event, ActionError):
            raise event
        return event


_Sink: TypeAlias = MemoryObjectSendStream[GoalInfo | GoalFeedback[FeedbackT] | ActionError]


@asynccontextmanager
async def events_of(
    endpoint: Endpoint, codec: Codec[FeedbackT], thread: OwnThread, *, feedback: bool
) -> AsyncGenerator[Events[FeedbackT], None]:
    """Follow all goals of the endpoint, beginning with those that it knows now.

    Raises:
        TransportError: The server cannot be asked: see `Endpoint.status`.
        RuntimeError: This is another thread than that of the client.
    """
    thread.check()
    with await endpoint.status() as statuses:
        send, receive = anyio.create_memory_object_stream[
            GoalInfo | GoalFeedback[FeedbackT] | ActionError
        ](BUFFER)
        with receive:
            async with Background() as tasks:
                merger = _Merger(endpoint, codec, send, tasks if feedback else None)
                tasks.start_soon(merger.run, statuses)
                yield Events(receive, statuses)


class _Merger(Generic[FeedbackT]):
    """The tasks that merge statuses and feedback: see the theory of operation above."""

    def __init__(
        self,
        endpoint: Endpoint,
        codec: Codec[FeedbackT],
        sink: _Sink[FeedbackT],
        tasks: TaskGroup | None,
    ) -> None:
        self._endpoint = endpoint
        self._codec = codec
        self._sink = sink
        self._tasks = tasks
        # The ends that wait for the feedback of their goal; None once that feedback has ended.
        self._late: dict[GoalID, list[GoalInfo] | None] = {}

    async def run(self, statuses: StatusStream) -> None:
        """Send every status change, until the server stops."""
        known = statuses.known
        async with self._sink:
            try:
                while (info := await statuses.receive()) is not None:
                    await self._tell(info, is_new=known <= 0)
                    known -= 1
            except ActionError as exc:
                await self._sink.send(exc)

    async def _tell(self, info: GoalInfo, *, is_new: bool) -> None:
        goal_id, is_active = info.goal_id, info.status.is_active
        late = self._late.get(goal_id)
        if late is not None and not is_active:
            late.append(info)  # its feedback comes first
            return
        await self._sink.send(info)
        if not is_active:
            self._late.pop(goal_id, None)
        elif goal_id not in self._late and self._tasks is not None:
            self._late[goal_id] = []
            after = 0 if is_new else None
            self._tasks.start_soon(self._follow, goal_id, after, self._sink.clone())

    async def _follow(self, goal_id: GoalID, after: int | None, sink: _Sink[FeedbackT]) -> None:
        async with sink:
            try:
                with await self._endpoint.feedback(goal_id, after=after) as stream:
                    while (item := await stream.receive()) is not None:
                        feedback = self._codec.decode(item.payload)
                        await sink.send(
                            GoalFeedback(goal_id, item.number, feedback, item.attempt, item.at)
                        )
            except UnknownGoal:
                pass  # it ended and was forgotten in the meantime
            except ActionError as exc:
                await sink.send(exc)
            late = self._late[goal_id]
            assert late is not None
            has_ended = bool(late)
            while late:
                await sink.send(late[0])
                del late[0]
            if has_ended:
                del self._late[goal_id]
            else:
                self._late[goal_id] = None
