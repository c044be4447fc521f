"""What `fibaction top` shows: actions, goals, rates and the latest feedback, gathered from what
happens. It knows nothing of the screen.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import anyio
import msgspec

from fibaction.action import ActionInfo
from fibaction.cli.goal_list import AnyClient, Row
from fibaction.cli.observing import LOOK, Observer
from fibaction.cli.progress import on_one_line
from fibaction.cli.yaml_text import as_yaml
from fibaction.events import GoalFeedback
from fibaction.exceptions import ActionError
from fibaction.goals import CancelAnswer, GoalID, GoalInfo
from fibaction.states import GoalStatus

SPAN = 5.0
"""Seconds over which a rate is measured: shorter, and it flickers; longer, and it is late."""


class GoalKey(NamedTuple):
    """What names a goal among those of all actions."""

    action: str
    goal_id: GoalID


class Rate:
    """How often something happens."""

    def __init__(self) -> None:
        self.count = 0
        self._samples: deque[tuple[float, int]] = deque()

    def sample(self, now: float) -> None:
        """Remember how many there have been by now."""
        self._samples.append((now, self.count))
        while len(self._samples) > 2 and self._samples[1][0] <= now - SPAN:
            self._samples.popleft()

    @property
    def per_second(self) -> float:
        """The rate over the last `SPAN` seconds; 0 if nothing is known yet."""
        if len(self._samples) < 2:
            return 0.0
        (began, before), (ended, after) = self._samples[0], self._samples[-1]
        return (after - before) / (ended - began) if ended > began else 0.0


class GoalLine:
    """One goal, as far as it is known."""

    def __init__(self, action: str, info: GoalInfo) -> None:
        self.row = Row(action, info)
        self.rate = Rate()
        self.line = ""
        """The latest feedback, on one line, which is not all of it."""
        self.text = ""
        """The latest feedback as YAML; what is too long is cut."""
        self._latest: GoalFeedback[Any] | None = None
        self._number = 0

    @property
    def key(self) -> GoalKey:
        """What names it."""
        return GoalKey(self.row.action, self.row.info.goal_id)

    @property
    def status(self) -> GoalStatus:
        """The status that was last heard of."""
        return self.row.info.status

    def update(self, info: GoalInfo) -> None:
        """Take what is newer there: what is asked for and what is told may cross on the way."""
        now = self.row.info
        status = max(now.status, info.status)
        count = max(now.feedback_count, info.feedback_count)
        client = info.client or now.client
        info = msgspec.structs.replace(info, status=status, feedback_count=count, client=client)
        self.row = Row(self.row.action, info)

    def feedback(self, event: GoalFeedback[Any]) -> int:
        """Take feedback; gives how many there have been since the one before."""
        # Where nobody has seen the first, the second is not one after zero.
        more = event.number - self._number if self._number else 1
        self._number, self._latest = event.number, event
        self.rate.count += more
        self.update(msgspec.structs.replace(self.row.info, feedback_count=event.number))
        return more

    def sample(self, now: float) -> None:
        """Keep the rate, and the words for the latest feedback, up to date."""
        self.rate.sample(now)
        if self._latest is not None:
            self.line = on_one_line(self._latest.feedback)
            self.text = as_yaml(self._latest.feedback)
            self._latest = None


class ActionLine:
    """One action."""

    def __init__(self, info: ActionInfo) -> None:
        self.info = info
        self.client: AnyClient | None = None
        self.away = ""
        """Why it cannot be followed; empty if it is."""
        self.rate = Rate()
        self.active = self.ended = 0


class Board(Observer):
    """All of it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.actions: dict[str, ActionLine] = {}
        self.goals: dict[GoalKey, GoalLine] = {}
        self.away = ""
        """Why the server cannot be reached; empty if it can."""
        self._clock = clock

    # What it hears

    def found(self, info: ActionInfo, client: AnyClient) -> None:
        line = self.actions.setdefault(info.name, ActionLine(info))
        line.client, line.away = client, ""

    def told(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        key = GoalKey(action, event.goal_id)
        line = self.goals.get(key)
        if isinstance(event, GoalFeedback):
            if line is not None:
                self.actions[action].rate.count += line.feedback(event)
        elif event.status is GoalStatus.UNKNOWN:
            self.goals.pop(key, None)
        elif line is None:
            self.goals[key] = GoalLine(action, event)
        else:
            line.update(event)

    def gone(self, action: str, why: str) -> None:
        if action in self.actions:
            self.actions[action].away = why

    def reached(self, actions: list[ActionInfo] | None, why: str) -> None:
        self.away = "" if actions is not None else why
        for info in actions or ():
            self.actions.setdefault(info.name, ActionLine(info)).info = info

    # What it asks

    async def keep(self) -> None:
        """Ask for all goals again and again: for their feedback counts, and because a server that
        was started anew says nothing of the goals of the one before. It has no end of its own.
        """
        while True:
            await anyio.sleep(LOOK)
            for line in list(self.actions.values()):
                if line.client is not None:
                    with anyio.move_on_after(LOOK):
                        await self._ask(line.info.name, line.client)

    async def _ask(self, action: str, client: AnyClient) -> None:
        before = {key for key in self.goals if key.action == action}
        try:
            infos = await client.goals()
        except ActionError:
            return  # who follows it finds out as well
        for info in infos:
            self.told(action, info)
        for key in before - {GoalKey(action, info.goal_id) for info in infos}:
            self.goals.pop(key, None)

    async def cancel(self, key: GoalKey) -> CancelAnswer:
        """Ask to cancel a goal.

        Raises:
            ServerNotFound, ConnectionLost: The server cannot be asked.
        """
        client = self.actions[key.action].client
        assert client is not None  # it was found before its first goal
        return await client.cancel_goals(key.goal_id)

    # What it shows

    def sample(self) -> None:
        """Bring rates and counts up to date. To be called a few times a second."""
        now = self._clock()
        for action in self.actions.values():
            action.rate.sample(now)
            action.active = action.ended = 0
        for goal in self.goals.values():
            goal.sample(now)
            action = self.actions[goal.row.action]
            action.active += goal.status.is_active
            action.ended += not goal.status.is_active

    def ordered(self, most: int) -> list[GoalLine]:
        """The first so many goals: active ones, then those that have ended, the newest first."""
        return sorted(self.goals.values(), key=lambda line: line.row.rank)[:most]
