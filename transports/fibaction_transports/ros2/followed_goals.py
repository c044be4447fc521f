"""The goals that a client follows, and the requests for their results.

Each stream asks for its goal's result as soon as the goal is accepted; the server answers when the
goal has ended. A request or an answer may be lost, and then the status list is the first to tell
that the goal has ended: `LATE` seconds after that, the result is requested again. Each further
request follows after a longer pause, so that requests do not pile up at a busy server.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from anyio import current_time

from fibaction._log import clean_logger
from fibaction.exceptions import ConnectionLost, ProtocolError
from fibaction.goals import GoalID
from fibaction.states import GoalStatus
from fibaction_transports.ros2.goal_stream import RosGoalStream
from fibaction_transports.ros2.rcl import uuid_of
from fibaction_transports.ros2.service_client import send_request
from fibaction_transports.ros2.status_list import ReceivedStatuses
from fibaction_transports.ros2.waitable import Responses

LATE = 0.5
"""Seconds after which a result that should be there is requested again."""
FAILED_REQUESTS = 2
"""Failed requests for a goal's result after which an unreadable response is attributed to it."""

ENDED = 1000
"""Ended goals that are remembered, to tell of feedback that arrives too late."""

logger = clean_logger("fibaction.ros2")


class FollowedGoals:
    """The streams of the goals that a client follows, and a service client for their results."""

    def __init__(
        self, action: str, handle: Any, service_type: Any, known: ReceivedStatuses
    ) -> None:
        self._action = action
        self._handle = handle
        self._request_type = service_type.Request
        self._known = known
        self._streams: dict[bytes, list[RosGoalStream]] = {}
        self._requested: dict[int, RosGoalStream] = {}
        self._overdue: dict[GoalID, float] = {}
        self._ended: deque[bytes] = deque(maxlen=ENDED)
        self.source = Responses(handle, service_type, self._take_result, self._take_unreadable)
        """The source of the results."""

    def __bool__(self) -> bool:
        return bool(self._streams)

    def __iter__(self) -> Iterator[RosGoalStream]:
        return iter([stream for streams in self._streams.values() for stream in streams])

    def of(self, goal_id: bytes) -> Sequence[RosGoalStream]:
        """Return the streams that follow this goal."""
        return self._streams.get(goal_id, ())

    def add(self, stream: RosGoalStream) -> None:
        """Tell the stream from now on what arrives of its goal."""
        self._streams.setdefault(stream.goal_id, []).append(stream)

    def remove(self, stream: RosGoalStream) -> None:
        """Tell the stream nothing more. Does nothing if it has been removed."""
        streams = self._streams.get(stream.goal_id, [])
        if stream in streams:
            streams.remove(stream)
        for number in stream.requests:
            self._requested.pop(number, None)
        if not streams:
            self._streams.pop(stream.goal_id, None)
            self._overdue.pop(stream.goal_id, None)

    def warn_of_late_feedback(self, goal_id: bytes) -> None:
        """Log once that feedback of a goal has arrived after its result, and is lost."""
        if goal_id in self._ended:
            self._ended.remove(goal_id)
            logger.warning(
                "%s: feedback of goal %s arrived after its result, and is lost",
                self._action,
                GoalID(goal_id),
            )

    def request_result(self, stream: RosGoalStream) -> None:
        """Request the result of the stream's goal.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        request = self._request_type()
        request.goal_id.uuid = uuid_of(stream.goal_id)
        number = send_request(self._handle, request)
        stream.requests.append(number)
        self._requested[number] = stream

    def expect_result(self, goal_id: GoalID, seconds: float) -> None:
        """Request the result again if it is not there after so many seconds."""
        self._overdue.setdefault(goal_id, current_time() + seconds)

    def retry_overdue(self) -> None:
        """Request the results again that should be there.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        now = current_time()
        for goal_id, when in tuple(self._overdue.items()):
            if when <= now:
                del self._overdue[goal_id]
                for stream in self.of(goal_id):
                    logger.info("%s: requesting the result of goal %s again", self._action, goal_id)
                    self.request_result(stream)
                    self._overdue[goal_id] = now + LATE * len(stream.requests)

    def resume(self) -> None:
        """Request all results once more: requests and answers may have been lost meanwhile.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        for stream in self:
            if stream.has_begun:
                stream.resumed += 1
                self.request_result(stream)

    def fail(self, error: ConnectionLost, streams: Iterable[RosGoalStream] | None = None) -> None:
        """End these streams with an error, by default all of them."""
        for stream in self if streams is None else streams:
            stream.fail(error)
            self.remove(stream)

    def _take_result(self, item: Any) -> None:
        number, response = item
        stream = self._requested.pop(number, None)
        if stream is None:
            return
        ended = list(self.of(stream.goal_id))
        if response.status == GoalStatus.UNKNOWN:
            info = self._known.get(stream.goal_id)
            if stream.has_begun and info is not None and info.status.is_active:
                # Another server has answered, which does not know the goal. Ask again, until the
                # one that has the goal answers.
                self.expect_result(stream.goal_id, LATE)
                return
            ended = [stream]
        if any(one.reads for one in ended):
            self._ended.append(bytes(stream.goal_id))
        for one in ended:
            try:
                one.end(one.decoder.outcome(response))
            except ProtocolError as exc:
                one.fail(exc)
            self.remove(one)

    def _take_unreadable(self, error: Exception) -> None:
        """Take a response that cannot be read, so that its request number is not known.

        Readable results come when they are requested. So the response belongs to a goal whose
        result was requested in vain.
        """
        for stream in self:
            if len(stream.requests) - stream.resumed > FAILED_REQUESTS:
                stream.fail(ProtocolError(f"the goal's result cannot be read: {error}"))
                self.remove(stream)
