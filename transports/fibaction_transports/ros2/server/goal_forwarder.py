"""Forwards one goal of an endpoint to ROS: its feedback, its statuses, and its outcome."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import anyio

from fibaction.border.abc import FeedbackItem, GoalStream, Notifier
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus

BATCH = 32
"""Feedback messages that are published before other tasks get their turn on the event loop."""
GRACE = 1.0
"""Seconds that an outcome waits for the first client that asks for it. Clients of ROS ask only
after they were told of the acceptance, and a goal that ends at once may be forgotten by then."""


class GoalForwarder:
    """Follows a goal, publishes its feedback in order, and answers requests for its result."""

    def __init__(
        self,
        stream: GoalStream,
        publish: Callable[[bytes], Awaitable[None]],
        update: Callable[[GoalInfo], None],
    ) -> None:
        """`update` is called with each status before the end, ahead of the stream of all statuses,
        which may be read later.
        """
        self.stream = stream
        self.late: list[GoalInfo] = []
        """Statuses to publish after all feedback."""
        self._publish = publish
        self._update = update
        self._answer: Any = None
        self._asked = False
        self._waiting = 0
        self._news = Notifier()

    async def outcome(self) -> Outcome[bytes]:
        """Publish all feedback, then return the outcome; UNKNOWN if it cannot be known."""
        with self.stream as stream:
            try:
                while (outcome := await self._forward_some(stream)) is None:
                    pass
                return outcome
            except ActionError as exc:  # a gateway has lost the server behind it
                return Outcome(GoalStatus.UNKNOWN, reason=str(exc))

    async def _forward_some(self, stream: GoalStream) -> Outcome[bytes] | None:
        updates = stream.take(BATCH)
        if not updates:
            await stream.news.wait()
            return None
        for update in updates:
            if isinstance(update, FeedbackItem):
                await self._publish(update.payload)
            elif isinstance(update, GoalStatus):
                self._update(GoalInfo(stream.goal_id, stream.stamp, update))
            else:
                return update
        if isinstance(updates[-1], FeedbackItem):
            await anyio.lowlevel.checkpoint()
        return None

    @property
    def is_owed(self) -> bool:
        """True if the goal has ended: until this forwarder is done, a client waits for the end."""
        return self.stream.status.is_terminal

    def hurry(self) -> None:
        """Do not wait for clients that have yet to ask."""
        self._asked = True
        self._news.notify()

    async def hand_over(self, answer: Any) -> None:
        """Give the answer to all requests that wait, and wait a while for the first of them."""
        self._answer = answer
        self._news.notify()
        if not self._asked:
            with anyio.move_on_after(GRACE):
                while not self._asked:
                    await self._news.wait()
        while self._waiting:
            await self._news.wait()

    async def answer(self) -> Any:
        """Wait for the answer that `hand_over` gives, and return it."""
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
