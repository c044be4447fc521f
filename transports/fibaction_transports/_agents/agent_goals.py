"""`AgentGoal` and `AgentGoals`: the goals that a server for agents follows for them.

Theory of operation
-------------------

One task reads the stream of a goal to its end, whether or not an agent waits for it, so that no
executor waits for a model. It keeps the last updates: `most_kept` of them, and `MOST_BYTES`. Tools
of a model want the newest one only. Other agents iterate over `updates`, each with a position of
its own, so a connection that breaks costs nothing: the agent comes back with the position of the
last update that it has seen, and what was lost on the way is read again.

The goal waits for an agent that iterates slowly, as it waits for its own client at every other
door: while an agent is half of what is kept behind, the stream is not read, and the server of the
action holds the executor. An agent whose connection is lost keeps its position until one comes
back. The wait takes `LONGEST_WAIT` seconds at most, after which the slow positions are given up,
and what is lost there shows as a gap in the numbers.

The copy that is kept here is not the truth: after a restart, for a goal of another client, and for
one whose stream has failed, it begins with what the server of the action still has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from time import time
from typing import Generic, NamedTuple, TypeAlias

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import FeedbackItem, GoalStream, Notifier
from fibaction.border.event_loop import Background
from fibaction.client.attempts import cancel_left
from fibaction.words.errors import ActionError, LimitReached, ServerNotFound, UnknownGoal
from fibaction.words.goals import CancelCode, GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports._agents.robot_actions import ActionT, RobotActions

MOST_KEPT = 2000
"""Updates of a goal that are kept for agents that come back."""
MOST_BYTES = 2**18
"""Bytes of these updates; the newest one is kept in any case."""
LONGEST_WAIT = 10.0
"""Seconds that a goal waits for agents that read slowly, or whose connection is lost."""
MOST_ACTIVE = 100
"""Goals that are followed at once; more are not sent."""
MOST_ENDED = 100
"""Ended goals that are kept for agents to read."""
SEARCH_TIMEOUT = 5.0
"""Seconds in which the servers list their goals."""
CATCH_UP = 2.0
"""Seconds in which the updates of a goal arrive that its server has already."""

Position: TypeAlias = tuple[float, int]
"""The attempt and the number of a feedback."""
START: Position = (1, 0)
"""The position before the first update."""


class KeptUpdate(NamedTuple):
    """One update that is kept."""

    update: FeedbackItem | GoalStatus
    time: float
    """The time at which it was read, in seconds since 1970."""
    offset: int
    """Bytes of feedback that were read before it."""


class _UpdateReader:
    """One agent that iterates over the updates."""

    def __init__(self, number: int) -> None:
        self.number = number
        """The number of the next entry."""
        self.has_left = False
        """True if the agent reads no more, and may come back."""


class AgentGoal(Generic[ActionT]):
    """One goal, with its last updates."""

    def __init__(
        self,
        action: ActionT,
        stream: GoalStream,
        *,
        owner: str | None,
        context_id: str = "",
        most_kept: int = MOST_KEPT,
        on_change: Callable[[AgentGoal[ActionT]], None] = lambda _: None,
    ) -> None:
        """Keep so many updates, and call `on_change` after each change."""
        self.action = action
        self.stream = stream
        self.owner = owner
        """The client that has sent it here; None if it was sent elsewhere."""
        self.context_id = context_id or str(stream.goal_id)
        """The context that the agent gave, else the ID of the goal."""
        self.newest: FeedbackItem | None = None
        """The newest feedback."""
        self.count = 0
        """Feedback messages that were read. Unlike their numbers, it never decreases."""
        self.outcome: Outcome[bytes] | None = None
        self.error: ActionError | None = None
        """The reason why the goal cannot be followed any more; it may continue."""
        self.updated_at = time()
        """The time of the newest update, in seconds since 1970."""
        self.ended = anyio.Event()
        """Set when there is an outcome, or an error."""
        self.news = Notifier()
        self._most_kept = most_kept
        self._on_change = on_change
        self._entries: deque[KeptUpdate] = deque()
        self._first = 0  # the number of the first entry that is kept
        self._bytes = 0  # of all feedback so far
        self._readers: set[_UpdateReader] = set()
        self._moved = Notifier()

    @property
    def goal_id(self) -> GoalID:
        """The goal's ID."""
        return self.stream.goal_id

    @property
    def stamp(self) -> int:
        """The time of the acceptance, in nanoseconds since 1970."""
        return self.stream.stamp

    @property
    def status(self) -> GoalStatus:
        """The newest status."""
        return self.stream.status if self.outcome is None else self.outcome.status

    async def follow(self) -> None:
        """Read the goal to its end."""
        with self.stream:
            try:
                async for update in self.stream:
                    self.updated_at = time()
                    if isinstance(update, Outcome):
                        self.outcome = update
                    else:
                        self._keep(update)
                        await self._wait_for_readers()
            except ActionError as exc:
                self.error, self.updated_at = exc, time()
        self.ended.set()
        self._note_change()

    def feedback_after(self, count: int) -> list[FeedbackItem]:
        """Return the feedback that was read after so many messages, as far as it is kept."""
        kept = [one.update for one in self._entries if isinstance(one.update, FeedbackItem)]
        return kept[max(len(kept) - (self.count - count), 0) :]

    async def catch_up(self, info: GoalInfo) -> None:
        """Wait a moment for what the server of the goal has told about it in a list."""
        with anyio.move_on_after(CATCH_UP):
            if info.status.is_terminal:
                await self.ended.wait()
            wanted = info.feedback_count
            while not self.ended.is_set() and (self.newest.number if self.newest else 0) < wanted:
                await self.news.wait()

    async def cancel(self) -> str:
        """Ask the server to cancel the goal, and return why it rejects that; empty if it does not.

        Raises:
            ActionError: The server cannot be asked.
        """
        answer = await self.action.endpoint.cancel_goals(self.goal_id)
        if answer.return_code is not CancelCode.REJECTED:
            return ""
        return answer.reason or "it gives no reason"

    async def leave(self) -> None:
        """Cancel a goal that its client no longer waits for, also in a scope that is canceled."""
        await cancel_left(self.action.endpoint, self.goal_id)

    def _keep(self, update: FeedbackItem | GoalStatus) -> None:
        self._entries.append(KeptUpdate(update, self.updated_at, self._bytes))
        if isinstance(update, FeedbackItem):
            self.newest = update
            self.count += 1
            self._bytes += len(update.payload)
        entries = self._entries
        while len(entries) > self._most_kept or (
            len(entries) > 1 and self._bytes - entries[0].offset > MOST_BYTES
        ):
            entries.popleft()
            self._first += 1
        self._note_change()

    def _note_change(self) -> None:
        self.news.notify()
        self._on_change(self)

    # Agents that iterate over the updates

    async def updates(
        self, after: Position = START, *, statuses: bool = False
    ) -> AsyncGenerator[KeptUpdate, None]:
        """Iterate over the feedback after a position, and over the statuses from now on; with
        `statuses`, over all that are kept.

        It ends with the goal, or when the goal cannot be followed any more.
        """
        now = self._first if statuses else self._first + len(self._entries)
        self._readers = {reader for reader in self._readers if not reader.has_left}
        self._moved.notify()
        reader = _UpdateReader(self._first)
        self._readers.add(reader)
        try:
            while True:
                while (entry := self._next(reader)) is not None:
                    update = entry.update
                    if isinstance(update, FeedbackItem):
                        is_new = position(update) > after
                    else:  # the task that the agent sees first tells the status
                        is_new = reader.number > now
                    if is_new:
                        yield entry
                if self.ended.is_set():
                    break
                await self.news.wait()
            self._readers.discard(reader)
        finally:
            reader.has_left = True
            self._moved.notify()

    def _next(self, reader: _UpdateReader) -> KeptUpdate | None:
        reader.number = max(reader.number, self._first)
        if reader.number == self._first + len(self._entries):
            return None
        entry = self._entries[reader.number - self._first]
        reader.number += 1
        self._moved.notify()
        return entry

    async def _wait_for_readers(self) -> None:
        """Wait until no agent is far behind, for a limited time."""
        with anyio.move_on_after(LONGEST_WAIT) as limit:
            while self._slow_readers():
                await self._moved.wait()
        if limit.cancelled_caught:
            self._readers -= self._slow_readers()

    def _slow_readers(self) -> set[_UpdateReader]:
        return {reader for reader in self._readers if self._is_slow(reader)}

    def _is_slow(self, reader: _UpdateReader) -> bool:
        index = reader.number - self._first
        if index >= len(self._entries):
            return False
        is_behind = len(self._entries) - index > self._most_kept // 2
        return is_behind or self._bytes - self._entries[max(index, 0)].offset > MOST_BYTES // 2


def position(item: FeedbackItem) -> Position:
    """Return the position of a feedback."""
    return item.attempt, item.number


class AgentGoals(Generic[ActionT]):
    """The goals that one server for agents follows, by their IDs."""

    def __init__(
        self,
        actions: RobotActions[ActionT],
        *,
        most_kept: int = MOST_KEPT,
        on_change: Callable[[AgentGoal[ActionT]], None] = lambda _: None,
    ) -> None:
        """Follow goals of these actions; for the rest, see `AgentGoal`."""
        self._actions = actions
        self._most_kept = most_kept
        self._on_change = on_change
        self._goals: dict[GoalID, AgentGoal[ActionT]] = {}
        self._tasks: TaskGroup

    @asynccontextmanager
    async def followed(self) -> AsyncGenerator[TaskGroup, None]:
        """Follow the goals, and the actions, during the block, which gets a group of tasks.

        At its end, the goals continue at their servers.
        """
        async with Background() as self._tasks:
            self._tasks.start_soon(self._actions.follow)
            yield self._tasks

    def get(self, goal_id: GoalID) -> AgentGoal[ActionT] | None:
        """Return a goal that is known here, even one that cannot be followed any more."""
        return self._goals.get(goal_id)

    async def send(
        self,
        action: ActionT,
        goal_id: GoalID,
        payload: bytes,
        *,
        owner: str,
        context_id: str = "",
    ) -> AgentGoal[ActionT]:
        """Send a goal of a client, and follow it; also one that is sent again, whose owner is the
        client that was the first.

        Raises:
            GoalRejected: It was not accepted.
            LimitReached: It was not sent.
            ActionError: As for `Endpoint.offer_goal`.
        """
        if sum(not goal.ended.is_set() for goal in self._goals.values()) >= MOST_ACTIVE:
            raise LimitReached(
                f"{MOST_ACTIVE} goals are active here already; wait for one of them to end, or"
                " cancel it"
            )
        try:
            stream = await action.endpoint.send_goal(goal_id, payload)
        except anyio.get_cancelled_exc_class():
            # The server may have accepted the goal, and it would run without a client. One that is
            # sent again may run for an earlier request.
            if goal_id not in self._goals:
                await cancel_left(action.endpoint, goal_id)
            raise
        known = self._goals.get(goal_id)
        if known is not None and known.owner is not None:
            owner = known.owner
        return self._add(action, stream, owner=owner, context_id=context_id)

    async def find(self, goal_id: GoalID) -> AgentGoal[ActionT]:
        """Return a goal that is followed already, or follow a goal of the actions from now on.

        Raises:
            UnknownGoal: No server knows it.
            ServerNotFound: None of those that can be asked now knows it.
            ActionError: It cannot be followed now.
        """
        known = self._goals.get(goal_id)
        if known is not None and known.error is None:
            return known
        for action, infos in (await self.listed()).items():
            for info in infos:
                if info.goal_id == goal_id:
                    owner = None if known is None else known.owner
                    context_id = "" if known is None else known.context_id
                    stream = await action.endpoint.feedback(
                        goal_id, after=0, own=owner is not None, attempt=info.attempt
                    )
                    goal = self._add(action, stream, owner=owner, context_id=context_id)
                    await goal.catch_up(info)
                    return goal
        if not self._actions.are_all_reached:
            raise ServerNotFound("a server of the actions cannot be reached now: ask again")
        raise UnknownGoal(goal_id)

    async def listed(self) -> dict[ActionT, list[GoalInfo]]:
        """Return the goals that the servers know, of those that answer soon."""
        found: dict[ActionT, list[GoalInfo]] = {}

        async def ask(action: ActionT) -> None:
            with suppress(ActionError), await action.endpoint.status() as statuses:
                found[action] = await statuses.listed()

        with anyio.move_on_after(SEARCH_TIMEOUT):
            async with anyio.create_task_group() as tasks:
                for action in self._actions.by_label.values():
                    tasks.start_soon(ask, action)
        return found

    def _add(
        self, action: ActionT, stream: GoalStream, *, owner: str | None, context_id: str
    ) -> AgentGoal[ActionT]:
        goal = AgentGoal(
            action,
            stream,
            owner=owner,
            context_id=context_id,
            most_kept=self._most_kept,
            on_change=self._on_change,
        )
        self._goals.pop(goal.goal_id, None)
        ended = [one for one in self._goals.values() if one.ended.is_set()]
        for one in ended[: max(len(ended) - MOST_ENDED + 1, 0)]:
            del self._goals[one.goal_id]
        self._goals[goal.goal_id] = goal
        self._on_change(goal)
        self._tasks.start_soon(goal.follow)
        return goal
