"""A monitor of all actions of a server: their goals, feedback rates and latest feedback.

It is the model behind `fibaction top`, for other displays too. For example:

    async with connect("tcp://127.0.0.1:7400") as connection:
        monitor = Monitor()
        async with create_task_group() as tasks:
            tasks.start_soon(monitor.run, connection)
            while True:
                await sleep(0.5)
                for goal in monitor.snapshot().goals:
                    print(goal.action, goal.info.goal_id, goal.info.status.name, goal.latest)

A program that needs each event instead, for example a recorder, implements `ActionListener` and
runs `follow_actions`.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import anyio
import msgspec

from fibaction._api import ClientConnection
from fibaction.client.events import GoalFeedback
from fibaction.observe.action_listener import (
    PERIOD,
    ActionListener,
    AnyClient,
    follow_action,
    follow_actions,
)
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError
from fibaction.words.goals import NO_GOAL, CancelAnswer, GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus

__all__ = [
    "ActionListener",
    "ActionSnapshot",
    "AnyClient",
    "GoalKey",
    "GoalSnapshot",
    "Monitor",
    "Snapshot",
    "follow_action",
    "follow_actions",
    "newest_active_first",
]

SPAN = 5.0
"""Seconds over which a rate is measured: a shorter span flickers, a longer one is late."""

_NOT_WAITING = GoalInfo(NO_GOAL, 0, GoalStatus.UNKNOWN)


class Rate:
    """A count of events, and how often they happen."""

    def __init__(self) -> None:
        self.count = 0
        self._samples: deque[tuple[float, int]] = deque()

    def sample(self, now: float) -> None:
        """Record the count at this time."""
        self._samples.append((now, self.count))
        while len(self._samples) > 2 and self._samples[1][0] <= now - SPAN:
            self._samples.popleft()

    @property
    def per_second(self) -> float:
        """The rate over the last `SPAN` seconds; 0 before the second sample."""
        if len(self._samples) < 2:
            return 0.0
        (began, before), (ended, after) = self._samples[0], self._samples[-1]
        return (after - before) / (ended - began) if ended > began else 0.0


class MonitoredAction:
    """The state of one action."""

    def __init__(self, info: ActionInfo) -> None:
        self.info = info
        self.client: AnyClient | None = None
        self.away = ""
        self.rate = Rate()


class MonitoredGoal:
    """The state of one goal."""

    def __init__(self, info: GoalInfo) -> None:
        self.info = info
        self.rate = Rate()
        self.latest: Any = None
        """The summary of the latest feedback; None if none has come."""
        self._number = 0
        self._new: GoalFeedback[Any] | None = None

    def merge(self, info: GoalInfo) -> None:
        """Take what is newer there: answers and events may cross on the way."""
        status = max(self.info.status, info.status)
        waiting = info if info.place else self.info  # events tell no places
        if status is not GoalStatus.ACCEPTED:
            waiting = _NOT_WAITING
        attempt = max(self.info.attempt, info.attempt)
        counts = (one.feedback_count for one in (self.info, info) if one.attempt == attempt)
        self.info = msgspec.structs.replace(
            info,
            status=status,
            attempt=attempt,
            feedback_count=max(counts),
            client=info.client or self.info.client,
            parent=info.parent or self.info.parent,
            labels=info.labels or self.info.labels,
            worker=info.worker or self.info.worker,
            place=waiting.place,
            queue_length=waiting.queue_length,
            began_at=info.began_at or self.info.began_at,
            ended_at=info.ended_at or self.info.ended_at,
            reason=info.reason or ("" if status.is_active else self.info.reason),
        )

    def add_feedback(self, event: GoalFeedback[Any]) -> int:
        """Take feedback. Return how many messages there were since the one before."""
        # If the first one seen here is not number 1, its number says nothing about the rate. The
        # numbers begin again with each attempt.
        more = event.number - self._number if 0 < self._number < event.number else 1
        self._number, self._new = event.number, event
        self.rate.count += more
        count, attempt = event.number, event.attempt
        self.merge(msgspec.structs.replace(self.info, feedback_count=count, attempt=attempt))
        return more

    def summarize(self, summarize: Callable[[Any], Any] | None) -> None:
        """Make the summary of the latest feedback; with None, forget the feedback.

        It may be large, and a server may have many goals.
        """
        if self._new is not None:
            if summarize is not None:
                self.latest = summarize(self._new.feedback)
            self._new = None


MOST_GOALS = 10_000
"""Goals that a monitor keeps; each costs time at every snapshot."""


class GoalKey(NamedTuple):
    """The name of a goal among those of all actions."""

    action: str
    goal_id: GoalID


class GoalSnapshot(msgspec.Struct, frozen=True):
    """The state of one goal."""

    action: str
    info: GoalInfo
    feedback_rate: float
    """Feedback messages per second."""
    latest: Any
    """The latest feedback, as `summarize` returned it; None if none has come."""

    @property
    def key(self) -> GoalKey:
        """The goal's name."""
        return GoalKey(self.action, self.info.goal_id)


class ActionSnapshot(msgspec.Struct, frozen=True):
    """The state of one action."""

    info: ActionInfo
    away: str
    """The reason why the action cannot be followed; empty if it is."""
    active: int
    """Goals that have not ended."""
    ended: int
    """Goals that have ended and that the server remembers."""
    feedback_rate: float
    """Feedback messages per second, of all its goals."""


class Snapshot(msgspec.Struct, frozen=True):
    """The state of everything that a monitor follows, at one moment."""

    away: str
    """The reason why the server cannot be reached; empty if it can."""
    actions: list[ActionSnapshot]
    goals: list[GoalSnapshot]
    """Goals that were asked for; without a wish, all in the order of `newest_active_first`."""
    matching: int
    """Number of goals that match, those beyond `most_goals` included."""


def newest_active_first(info: GoalInfo) -> tuple[int, int]:
    """Return a key to sort goals by: active ones, those that wait in a queue, then ended ones.

    The newest are first, but among those that wait the next to start.
    """
    if info.place:
        return 1, info.place
    return (0 if info.status.is_active else 2), -info.stamp


class Monitor(ActionListener):
    """Keeps the state of all actions and goals, for `snapshot`.

    It keeps at most `MOST_GOALS` goals: those that it has heard of last.
    """

    def __init__(
        self,
        *,
        summarize: Callable[[Any], Any] = lambda feedback: feedback,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Make a monitor.

        `summarize` makes of the latest feedback of a goal what is kept of it, at most once for each
        snapshot: for example a short text, if feedback may be large.
        """
        self._summarize = summarize
        self._clock = clock
        self._away = ""
        self._actions: dict[str, MonitoredAction] = {}
        self._goals: dict[GoalKey, MonitoredGoal] = {}

    async def run(self, connection: ClientConnection) -> None:
        """Follow all actions of a connection, until canceled.

        Raises:
            ActionError: There is no server; or the connection is lost and is not reopened. Alone or
                in a group.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._refresh)
            await follow_actions(connection, self, feedback=True)

    async def cancel(self, key: GoalKey) -> CancelAnswer:
        """Ask the server to cancel a goal of a snapshot.

        Raises:
            ServerNotFound, ConnectionLost: The server cannot be asked.
        """
        return await self._client(key).cancel_goals(key.goal_id)

    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        """Wait for the end of a goal of a snapshot, and return its outcome.

        Raises:
            ActionError: The server cannot be asked, or the result cannot be read.
        """
        client = self._client(key)
        raw = await client.endpoint.get_result(key.goal_id)
        return raw.decoded(client.action.result.decode)

    async def request(self, key: GoalKey) -> Any:
        """Return the goal itself, as it was sent; None if its server does not tell it.

        Servers tell it while they remember the goal. ROS 2 does not.

        Raises:
            ActionError: The server cannot be asked, or the goal cannot be read.
        """
        client = self._client(key)
        stream = await client.endpoint.feedback(key.goal_id)
        stream.close()
        return None if stream.goal is None else client.action.goal.decode(stream.goal)

    def snapshot(
        self,
        most_goals: int | None = None,
        *,
        matches: Callable[[GoalSnapshot], bool] = lambda goal: True,
        order: Callable[[GoalSnapshot], Any] = lambda goal: newest_active_first(goal.info),
    ) -> Snapshot:
        """Return the state now, with the goals that match, at most so many, in an order.

        `order` returns a key to sort by. Neither function may look at `latest`: it is made for the
        goals that are returned, and feedback that came for others is forgotten. Rates are measured
        between calls: call it a few times a second.
        """
        now = self._clock()
        active, ended = Counter[str](), Counter[str]()
        for key, goal in self._goals.items():
            goal.rate.sample(now)
            (active if goal.info.status.is_active else ended)[key.action] += 1
        for action in self._actions.values():
            action.rate.sample(now)
        found = sorted(filter(matches, map(self._goal, self._goals)), key=order)
        return Snapshot(
            self._away,
            [
                ActionSnapshot(one.info, one.away, active[name], ended[name], one.rate.per_second)
                for name, one in self._actions.items()
            ],
            self._summarized([goal.key for goal in found[:most_goals]]),
            len(found),
        )

    def _summarized(self, keys: list[GoalKey]) -> list[GoalSnapshot]:
        for key in keys:
            self._goals[key].summarize(self._summarize)
        for record in self._goals.values():
            record.summarize(None)
        return [self._goal(key) for key in keys]

    def goal(self, key: GoalKey) -> GoalSnapshot | None:
        """Return one goal as the last snapshot found it; None if its server has forgotten it."""
        return self._goal(key) if key in self._goals else None

    def find(self, goal_id: GoalID) -> GoalSnapshot | None:
        """Return the goal of that ID, of any action; None if it is not known here."""
        for action in self._actions:
            if (key := GoalKey(action, goal_id)) in self._goals:
                return self._goal(key)
        return None

    def children(self, goal_id: GoalID) -> list[GoalSnapshot]:
        """Return the goals that the executor of a goal has sent, in the order of acceptance, as far
        as they are known here.
        """
        keys = [
            key
            for key, goal in self._goals.items()
            if goal.info.parent is not None and goal.info.parent.goal_id == goal_id
        ]
        return sorted(map(self._goal, keys), key=lambda goal: goal.info.stamp)

    def _goal(self, key: GoalKey) -> GoalSnapshot:
        record = self._goals[key]
        return GoalSnapshot(key.action, record.info, record.rate.per_second, record.latest)

    def _client(self, key: GoalKey) -> AnyClient:
        client = self._actions[key.action].client
        assert client is not None  # an action is found before its first goal
        return client

    # As a listener

    def on_action_found(self, info: ActionInfo, client: AnyClient) -> None:
        state = self._actions.setdefault(info.name, MonitoredAction(info))
        state.client, state.away = client, ""

    def on_event(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        key = GoalKey(action, event.goal_id)
        goal = self._goals.get(key)
        if isinstance(event, GoalFeedback):
            if goal is not None:
                self._actions[action].rate.count += goal.add_feedback(event)
        elif event.status is GoalStatus.UNKNOWN:
            self._goals.pop(key, None)
        elif goal is None:
            self._goals[key] = MonitoredGoal(event)
            if len(self._goals) > MOST_GOALS:
                del self._goals[next(iter(self._goals))]
        else:
            goal.merge(event)

    def on_action_lost(self, action: str, reason: str) -> None:
        if action in self._actions:
            self._actions[action].away = reason

    def on_actions(self, actions: list[ActionInfo] | None, reason: str) -> None:
        self._away = "" if actions is not None else reason
        for info in actions or ():
            self._actions.setdefault(info.name, MonitoredAction(info)).info = info

    async def _refresh(self) -> None:
        # Events do not tell feedback counts and places, nor that a restarted server has lost its
        # goals.
        while True:
            await anyio.sleep(PERIOD)
            for state in list(self._actions.values()):
                if state.client is not None:
                    with anyio.move_on_after(PERIOD):
                        await self._refresh_goals(state.info.name, state.client)

    async def _refresh_goals(self, action: str, client: AnyClient) -> None:
        before = {key for key in self._goals if key.action == action}
        try:
            infos = await client.goals()
        except ActionError:
            return  # `follow_action` reports it
        for info in sorted(infos, key=newest_active_first)[:MOST_GOALS]:
            self.on_event(action, info)
        for key in before - {GoalKey(action, info.goal_id) for info in infos}:
            self._goals.pop(key, None)
