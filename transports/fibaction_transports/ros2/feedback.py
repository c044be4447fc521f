"""The feedback topic of an action server of ROS, which carries the feedback of all its goals."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from anyio import current_time

from fibaction.exceptions import ProtocolError
from fibaction.goals import GoalID
from fibaction_transports.ros2 import names
from fibaction_transports.ros2.messages import RosCodec
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.rcl import raw, uuid_of

MATCH_TIMEOUT, MATCH_PAUSE = 0.5, 0.01
"""Seconds that the first feedback of a goal waits for subscribers which the graph knows, and that
the middleware has yet to connect; and between two looks, since ROS offers nothing to wait for."""
PACE = 0.1
"""Seconds that the feedback which fills half a queue takes at least: 5,000 messages in a second
with the usual depth. A reader of fibaction may be late by some 0.2 s."""
FIRST_PACE = 0.5
"""As `PACE`, when there is a new reader: what is sent to it first is often sent again, and that
takes its time."""
PIECES = 10
"""In so many pieces half a queue is sent, each in its share of the time. Of what comes in one go, a
middleware on a busy machine drops a part, and sends it again: feedback then comes behind the
result, and is lost. A tenth was small enough with Fast DDS, and is still many messages for each
wait."""


class FeedbackTopic:
    """Publishes feedback, no faster than readers can take it."""

    def __init__(
        self,
        ros: RosNode,
        action: str,
        full: names.ActionNames,
        message_type: Any,
        codec: RosCodec,
        depth: int,
    ) -> None:
        self._ros = ros
        self._action = action
        self._names = full
        self._type = message_type
        self._codec = codec
        self._publisher = ros.make(
            raw.Publisher, message_type, full.feedback, names.feedback(depth)
        )
        self._unmatched = 0
        self._half = (depth + 1) // 2
        self._piece = -(-self._half // PIECES)
        self._count = 0  # of the piece
        self._due = -math.inf
        self._to_new = 0  # how much more is sent at the first pace
        self._matched = 0

    def of(self, goal_id: GoalID) -> Callable[[bytes], Awaitable[None]]:
        """Gives what publishes a goal's feedback.

        Feedback that is no ROS message is left out, and said so once in ROS's log: the executor
        has gone on by then, and what it does is not worth less for it.
        """
        message = self._type()
        message.goal_id.uuid = uuid_of(goal_id)
        told = begun = False

        async def publish(payload: bytes) -> None:
            nonlocal told, begun
            try:
                message.feedback = self._codec.to_ros(payload)
            except ProtocolError as exc:
                if not told:
                    told = True
                    self._ros.complain(
                        f"{self._action}: feedback of goal {goal_id} is no ROS message,"
                        f" and is left out: {exc}"
                    )
                return
            if not begun:
                begun = True
                await self._all_matched()
            await self._keep_pace()
            self._ros.attempt(self._publisher.publish, message)

        return publish

    async def _all_matched(self) -> None:
        """Wait for subscribers that have just come: what is published before they are connected,
        they never see.
        """
        deadline = current_time() + MATCH_TIMEOUT
        while (missing := self._ros.attempt(self._missing, otherwise=0)) > self._unmatched:
            if current_time() >= deadline:
                self._unmatched = missing  # they want another quality of service, and never match
                break
            await anyio.sleep(MATCH_PAUSE)
        before, self._matched = self._matched, self._ros.attempt(self._readers, otherwise=0)
        if self._matched > before:
            self._to_new = self._half

    def _missing(self) -> int:
        node = self._ros.node
        listeners: int = node.count_subscribers(self._names.feedback)
        # Who can send goals listens to their feedback, but may be known for the one before the
        # other.
        clients: int = node.count_clients(self._names.send_goal)
        return max(listeners, clients) - self._readers()

    def _readers(self) -> int:
        count: int = self._publisher.get_subscription_count()
        return count

    async def _keep_pace(self) -> None:
        """Give readers the time to take what is published.

        A message too many pushes out the oldest. ROS tells nobody whether they have been read; and
        whether they have arrived, it tells only after seconds, in a call that stops all of Python.
        """
        now = current_time()
        while now < self._due and self._count >= self._piece:
            await anyio.sleep_until(self._due)  # and others may go on before
            now = current_time()
        if now >= self._due:
            pace = PACE
            if self._to_new > 0:
                self._to_new -= self._piece
                pace = FIRST_PACE
            self._count, self._due = 0, now + pace * self._piece / self._half
        self._count += 1
