"""One goal at the server: its feedback is published, and its end is handed to who waits for it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio

from fibaction._notify import Notifier
from fibaction.abc import FeedbackItem, GoalStream
from fibaction.exceptions import ActionError
from fibaction.goals import GoalInfo, Outcome
from fibaction.states import GoalStatus

BATCH = 32
"""How much feedback is published before others get their turn on the event loop."""
GRACE = 1.0
"""Seconds that an outcome waits for the first client who asks for it. ROS's clients ask only when
they have been told of the acceptance, and a goal that ends at once may be forgotten by then."""


class Pump:
    """Follows a goal, and publishes its feedback in order."""

    def __init__(
        self,
        stream: GoalStream,
        publish: Callable[[bytes], Awaitable[None]],
        tell: Callable[[GoalInfo], None],
    ) -> None:
        """`tell` is told each status up to the end, before the end: others may tell it later."""
        self.stream = stream
        self.late: list[GoalInfo] = []
        """Statuses to be told when all feedback has been published."""
        self._publish = publish
        self._tell = tell
        self._answer: Any = None
        self._asked = False
        self._waiting = 0
        self._news = Notifier()

    async def outcome(self) -> Outcome[bytes]:
        """Publish all feedback, then say how the goal ended; UNKNOWN if that cannot be known."""
        with self.stream as stream:
            try:
                while (outcome := await self._publish_some(stream)) is None:
                    await anyio.lowlevel.checkpoint()
                return outcome
            except ActionError as exc:  # a gateway has lost the server behind it
                return Outcome(GoalStatus.UNKNOWN, reason=str(exc))

    async def _publish_some(self, stream: GoalStream) -> Outcome[bytes] | None:
        updates = stream.take(BATCH)
        for update in updates:
            if isinstance(update, FeedbackItem):
                await self._publish(update.payload)
            elif isinstance(update, GoalStatus):
                self._tell(GoalInfo(stream.goal_id, stream.stamp, update))
            else:
                return update
        if not updates:
            await stream.news.wait()
        return None

    @property
    def is_owed(self) -> bool:
        """Whether the goal has ended, and not everybody has been told."""
        return self.stream.status.is_terminal

    def hurry(self) -> None:
        """Do not wait for clients who have yet to ask."""
        self._asked = True
        self._news.notify()

    async def hand_over(self, answer: Any) -> None:
        """Give that to all who wait for the end, and to the first who will, for a while."""
        self._answer = answer
        self._news.notify()
        if not self._asked:
            with anyio.move_on_after(GRACE):
                while not self._asked:
                    await self._news.wait()
        while self._waiting:
            await self._news.wait()

    async def answer(self) -> Any:
        """Wait for the end, and for what `hand_over` gives."""
        self._asked = True
        self._waiting += 1
        self._news.notify()
        try:
            while self._answer is None:
                await self._news.wait()
            return self._answer
        finally:
            self._waiting -= 1
            self._news.notify()
