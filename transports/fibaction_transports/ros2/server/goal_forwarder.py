"""Forwards goals of an endpoint to ROS: their statuses and outcomes, and feedback to its topic."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
from anyio import current_time

from fibaction.border.abc import FeedbackItem, GoalStream, Notifier
from fibaction.words.errors import ActionError, ProtocolError
from fibaction.words.goals import GoalID, GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.conversion import RosCodec
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.settings import RosSettings

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
