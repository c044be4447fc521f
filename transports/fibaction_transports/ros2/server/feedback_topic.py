"""The feedback topic of an action server of ROS, which carries the feedback of all its goals."""

from __future__ import annotations

import math
from typing import Any

import anyio
from anyio import current_time

from fibaction.words.errors import ProtocolError
from fibaction.words.goals import GoalID
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.conversion import RosCodec
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.settings import RosSettings

MATCH_TIMEOUT, MATCH_PAUSE = 0.5, 0.01
"""Seconds that the first feedback of a goal waits for subscribers that are in the graph and not yet
connected; and seconds between two looks, since ROS offers nothing to wait for."""
LOOK_PAUSE = 0.05
"""Seconds after which readers are looked up again although their number has not changed."""
PACE = 0.1
"""The least number of seconds for half a queue of feedback: 5,000 messages in a second with the
default depth. A reader of fibaction may be late by about 0.2 s."""
TAKEN_PACE = 0.03
"""The same while the readers are known to have taken what was published: 16,700 in a second."""
FIRST_PACE = 0.5
"""The same for a new reader: its first messages are often sent again, which takes time."""
PIECES = 10
"""The number of pieces in which half a queue is sent, each in its share of the time. On a busy
machine, the middleware drops a part of a long burst, and sends it again: that feedback arrives
after the result, and only clients of fibaction wait for it. A tenth was small enough with Fast DDS,
and is still many messages for each wait."""


class FeedbackTopic:
    """Publishes feedback, no faster than readers can take it."""

    def __init__(
        self,
        ros: RosNode,
        action: str,
        full: ActionNames,
        message_type: Any,
        codec: RosCodec,
        settings: RosSettings,
    ) -> None:
        self._ros = ros
        self._action = action
        self._names = full
        self._type = message_type
        self._codec = codec
        depth = settings.feedback_depth
        profile = qos.feedback(depth, settings.feedback_qos)
        self._publisher = ros.publisher(full.feedback, message_type, profile)
        self._unmatched = 0
        self._half = (depth + 1) // 2
        self._piece = -(-self._half // PIECES)
        self._count = 0  # messages of the piece
        self._due = -math.inf
        self._to_new = 0  # messages that are still sent at the first pace
        self._count_then, self._looked = 0, -math.inf
        self._known: frozenset[bytes] = frozenset()
        """The readers at the last look, as ROS identifies them (by GIDs)."""

    def of(self, goal_id: GoalID) -> FeedbackPublisher:
        """Return the feedback of a goal, which has yet to be published."""
        message = self._type()
        message.goal_id.uuid = self._ros.types.uuid(goal_id)
        return FeedbackPublisher(self, goal_id, message)

    def convert(self, payload: bytes) -> Any:
        """Return feedback as its ROS type.

        Raises:
            ProtocolError: It does not fit.
        """
        return self._codec.to_ros(payload)

    def complain(self, goal_id: GoalID, error: ProtocolError) -> None:
        """Write to ROS's log that feedback of a goal does not fit its ROS type."""
        self._ros.complain(
            f"{self._action}: feedback of goal {goal_id} does not fit its ROS type, and is left"
            f" out: {error}"
        )

    async def publish(self, message: Any, *, is_first: bool) -> None:
        """Publish a message when its turn has come; the first of a goal waits for new readers."""
        if is_first:
            await self._all_matched()
        await self._keep_pace()
        self._publisher.publish(message)

    async def _all_matched(self) -> None:
        """Wait for new subscribers to be connected. They never get what is published before."""
        deadline = current_time() + MATCH_TIMEOUT
        while (missing := self._missing()) > self._unmatched:
            if current_time() >= deadline:
                self._unmatched = missing  # they have another quality of service, and never match
                break
            await anyio.sleep(MATCH_PAUSE)
        self._note_readers()

    def _note_readers(self) -> None:
        """Begin slowly if there is a new reader. A number alone does not tell of it if another has
        left.
        """
        now = current_time()
        count = self._publisher.reader_count()
        if count == self._count_then and now - self._looked < LOOK_PAUSE:
            return
        self._count_then, self._looked = count, now
        found = self._ros.subscriptions(self._names.feedback)
        before, self._known = self._known, frozenset(one.gid for one in found)
        if not self._known <= before:
            self._to_new = self._half

    def _missing(self) -> int:
        listeners = self._ros.count_subscriptions(self._names.feedback)
        # Each client of the goal service has a subscription, too. Either may be discovered first.
        clients = self._ros.count_callers(self._names.send_goal)
        return max(listeners, clients) - self._publisher.reader_count()

    async def _keep_pace(self) -> None:
        """Wait until readers have had the time to take what was published.

        A message beyond the depth of a queue pushes out the oldest. ROS does not tell if messages
        were read. It tells if they have arrived, but only after seconds, and in a call that stops
        all of Python.
        """
        now = current_time()
        while now < self._due and self._count >= self._piece:
            await anyio.sleep_until(self._due)  # others may fill the piece meanwhile
            now = current_time()
        if now >= self._due:
            pace = TAKEN_PACE if self._publisher.has_arrived(self._half) else PACE
            if self._to_new > 0:
                self._to_new -= self._piece
                pace = FIRST_PACE
            self._count, self._due = 0, now + pace * self._piece / self._half
        self._count += 1


class FeedbackPublisher:
    """The feedback of one goal, on its way to the topic."""

    def __init__(self, topic: FeedbackTopic, goal_id: GoalID, message: Any) -> None:
        self.count = 0
        """The number of messages that were published."""
        self._topic = topic
        self._goal_id = goal_id
        self._message = message
        self._has_complained = False

    async def publish(self, payload: bytes) -> None:
        """Publish feedback.

        Feedback that does not fit its ROS type is left out, with one error for each goal in ROS's
        log. The goal continues: its executor has already continued.
        """
        try:
            self._message.feedback = self._topic.convert(payload)
        except ProtocolError as exc:
            if not self._has_complained:
                self._has_complained = True
                self._topic.complain(self._goal_id, exc)
            return
        self.count += 1
        await self._topic.publish(self._message, is_first=self.count == 1)
