"""All that happens to the goals of one action, in one stream: what a log or a monitor wants.

It follows the statuses, and the feedback of each goal as an observer, who slows nothing down.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Generic, TypeAlias

import anyio
import msgspec
from anyio.abc import TaskGroup
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream

from fibaction._tasks import Background
from fibaction.abc import Endpoint, StatusStream
from fibaction.action import Codec, FeedbackT
from fibaction.exceptions import ActionError, UnknownGoal
from fibaction.goals import GoalID, GoalInfo

BUFFER = 64
"""Events that wait for the reader; then the streams behind wait, each with a window of its own."""


class GoalFeedback(msgspec.Struct, Generic[FeedbackT], frozen=True):
    """One feedback message of one of the goals."""

    goal_id: GoalID
    number: int
    """Its place among the feedback of the goal: 1, 2, 3 and so on; a gap tells what was missed."""
    feedback: FeedbackT


class Events(Generic[FeedbackT]):
    """What happens, for `async for`; it ends when the server stops, or its block has been left."""

    def __init__(
        self,
        stream: MemoryObjectReceiveStream[GoalInfo | GoalFeedback[FeedbackT] | ActionError],
        statuses: StatusStream,
    ) -> None:
        self._stream = stream
        self._statuses = statuses

    @property
    def dropped(self) -> int:
        """How many changes of a status were missed, because they were not read in time."""
        return self._statuses.dropped

    def __aiter__(self) -> Events[FeedbackT]:
        return self

    async def __anext__(self) -> GoalInfo | GoalFeedback[FeedbackT]:
        """The next event.

        Raises:
            StopAsyncIteration: The server has stopped, or the block of the events was left.
            ConnectionLost: The connection ended.
            TransportError: The server cannot tell more, or may not.
            ProtocolError: The server sent what is not of the feedback's type.
        """
        try:
            event = await self._stream.__anext__()
        except anyio.ClosedResourceError:  # as for whoever waits here while the block is left
            raise StopAsyncIteration from None
        if isinstance(event, ActionError):
            raise event
        return event


_Sink: TypeAlias = MemoryObjectSendStream[GoalInfo | GoalFeedback[FeedbackT] | ActionError]


@asynccontextmanager
async def events_of(
    endpoint: Endpoint, codec: Codec[FeedbackT], *, feedback: bool
) -> AsyncGenerator[Events[FeedbackT], None]:
    """All that happens at the endpoint, from every goal that it knows now on.

    Raises:
        TransportError: The server cannot be asked: see `Endpoint.status`.
    """
    with await endpoint.status() as statuses:
        send, receive = anyio.create_memory_object_stream[
            GoalInfo | GoalFeedback[FeedbackT] | ActionError
        ](BUFFER)
        with receive:
            async with Background() as tasks:
                observer = _Observer(endpoint, codec, send, tasks if feedback else None)
                tasks.start_soon(observer.run, statuses)
                yield Events(receive, statuses)


class _Observer(Generic[FeedbackT]):
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
        # The goals that are followed, each with what waits for its feedback; None if there is no
        # more feedback, and the end is still to be told: it is not to be followed again.
        self._late: dict[GoalID, list[GoalInfo] | None] = {}

    async def run(self, statuses: StatusStream) -> None:
        """Tell every change, until there are no more."""
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
                        await sink.send(GoalFeedback(goal_id, item.number, feedback))
            except UnknownGoal:
                pass  # it has ended and been forgotten in the meantime
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
