"""The goals that a client follows, and the requests for their results.

Each stream asks for its goal's result as soon as the goal is accepted; the server answers when the
goal has ended. The only server, if it is one of fibaction, is asked right after the goal was sent:
the result of a short goal then follows its acceptance, without another way to the server and back.
A request or an answer may be lost, and then the status list is the first to tell that the goal has
ended: `LATE` seconds after that, the result is requested again. Each further request follows after
a longer pause, so that requests do not pile up at a busy server.

A server of fibaction publishes the feedback, then the number of its messages (`feedback_counts`),
then the terminal status, and then it answers with the result. Feedback may still arrive after the
result, if the middleware had to send it again. If the server tells the number, the stream of a goal
continues until all messages are there, for `LATE_FEEDBACK` seconds (4) at most; what is missing
then is lost, and is counted. Another server tells none. Then the middleware is asked whether
messages are missing that were published before (`TopicSubscription.when_caught_up`): over DDS
without ROS the stream continues until they are there, and with rclpy, feedback after the result is
dropped. Where several servers run the goal, it continues until it is known which of them has
accepted it, for `LATE` seconds at most.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from anyio import current_time

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost, ProtocolError
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.client.status_lists import ReceivedStatuses
from fibaction_transports.ros2.convert.status_bytes import goal_of_feedback
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.qos import EndQos

LATE = 0.5
"""Seconds after which a result that should be there is requested again."""
LATE_FEEDBACK = 4.0
"""Seconds after the result for which feedback that is known to be missing is waited for. A reader
of Fast DDS may learn only by the next heartbeat, which comes every 3 s, that it has missed any."""
FAILED_REQUESTS = 2
"""Failed requests for a goal's result after which an unreadable response is attributed to it."""

ENDED = 1000
"""Ended goals that are remembered, to notice what arrives of them too late."""

logger = clean_logger("fibaction.ros2")


class _EndedGoal(NamedTuple):
    """A goal whose result has arrived."""

    stamp: int
    is_read: bool
    """True if feedback that arrives now is lost to a reader."""


class FollowedGoals:
    """The streams of the goals that a client follows, and a service client for their results."""

    def __init__(
        self,
        ros: RosNode,
        action: str,
        service: str,
        service_type: Any,
        qos: EndQos,
        known: ReceivedStatuses,
        *,
        is_reliable: bool,
        catch_up: Callable[[Callable[[], None]], None],
    ) -> None:
        """Make the client of the service for results.

        `is_reliable` says that the middleware sends lost feedback again. `catch_up` is called when
        a goal has ended, and calls back when no feedback from before is on its way any more.

        Raises:
            TransportError: ROS does not allow it.
        """
        self._types = ros.types
        self._action = action
        self._request_type = service_type.Request
        self._known = known
        self._patience = LATE_FEEDBACK if is_reliable else 0.0
        self._catch_up = catch_up
        self._streams: dict[bytes, list[RosGoalStream]] = {}
        self._requested: dict[int, RosGoalStream] = {}
        self._overdue: dict[GoalID, float] = {}
        self._unfinished: dict[RosGoalStream, float] = {}
        """The streams that have their outcome and wait for feedback, each with the time until which
        they wait."""
        self._ended: dict[bytes, _EndedGoal] = {}
        self.results = ros.caller(
            service,
            service_type,
            qos,
            self._take_result,
            self._take_unreadable,
            self._take_unanswered,
        )
        """The client of the service for results."""

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
        self._unfinished.pop(stream, None)
        for number in stream.requests:
            self._requested.pop(number, None)
            self.results.forget(number)
        if not streams:
            self._streams.pop(stream.goal_id, None)
            self._overdue.pop(stream.goal_id, None)

    def take_feedback(self, message: bytes, publisher: bytes) -> None:
        """Take a feedback message, and the GID of its publisher."""
        goal_id = goal_of_feedback(message)
        streams = self.of(goal_id)
        if not streams:
            self._warn_of_late_feedback(goal_id)
        for stream in tuple(streams):
            stream.add_feedback(message, publisher)
            self._finish_if_complete(stream)

    def note_lost(self, count: int) -> None:
        """Note that feedback is lost. It is known whose it was if one goal is followed."""
        if len(self._streams) == 1:
            for stream in self:
                stream.note_lost(count)

    def take_from(self, stream: RosGoalStream, publishers: frozenset[bytes]) -> None:
        """Take the goal's feedback from these publishers only; from all if there are none."""
        stream.take_from(publishers)
        self._finish_if_complete(stream)

    def active(self, goal_id: bytes) -> GoalInfo | None:
        """Return an active goal of the last status list. The result of a goal may arrive before
        the list that tells its end; then the goal is not active any more.
        """
        info, ended = self._known.get(goal_id), self._ended.get(goal_id)
        if info is None or not info.status.is_active:
            return None
        return None if ended is not None and ended.stamp == info.stamp else info

    def take_count(self, goal_id: bytes, count: int) -> None:
        """Take the number of feedback messages that a goal had in all."""
        for stream in tuple(self.of(goal_id)):
            stream.set_total(count)
            self._finish_if_complete(stream)

    def _finish_if_complete(self, stream: RosGoalStream) -> None:
        if stream in self._unfinished and stream.missing == 0:
            self._finish(stream)

    def _take_rest(self, stream: RosGoalStream) -> None:
        """Note that all feedback of a stream has arrived, as far as that can be known."""
        stream.awaits_rest = False
        self._finish_if_complete(stream)

    def finish_overdue(self) -> None:
        """End the streams whose missing feedback has not arrived in time: it is lost."""
        now = current_time()
        for stream, when in tuple(self._unfinished.items()):
            if when > now and stream.reads:
                continue
            self._finish(stream)
            if stream.missing:
                logger.warning(
                    "%s: %d feedback messages of goal %s are lost",
                    self._action,
                    stream.missing,
                    stream.goal_id,
                )

    def _finish(self, stream: RosGoalStream) -> None:
        self._ended[stream.goal_id] = _EndedGoal(stream.stamp, stream.reads)
        if len(self._ended) > ENDED:
            del self._ended[next(iter(self._ended))]
        stream.finish()
        self.remove(stream)

    def _warn_of_late_feedback(self, goal_id: bytes) -> None:
        """Log once that feedback of a goal has arrived after its result, and is lost."""
        ended = self._ended.get(goal_id)
        if ended is not None and ended.is_read:
            self._ended[goal_id] = ended._replace(is_read=False)
            logger.warning(
                "%s: feedback of goal %s arrived after its result, and is lost",
                self._action,
                GoalID(goal_id),
            )

    def request_result(self, stream: RosGoalStream) -> int:
        """Request the result of the stream's goal, and return the number of the request.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        request = self._request_type()
        request.goal_id.uuid = self._types.uuid(stream.goal_id)
        number = self.results.send(request)
        stream.requests.append(number)
        self._requested[number] = stream
        return number

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
                    if stream in self._unfinished:
                        continue
                    logger.info("%s: requesting the result of goal %s again", self._action, goal_id)
                    self.request_result(stream)
                    self._overdue[goal_id] = now + LATE * len(stream.requests)

    def resume(self) -> None:
        """Request all results once more: requests and answers may have been lost meanwhile.

        Raises:
            ConnectionLost: ROS cannot send any more.
        """
        for stream in self:
            if stream.has_begun and stream not in self._unfinished:
                stream.resumed += 1
                self.request_result(stream)

    def fail(self, error: ConnectionLost, streams: Iterable[RosGoalStream] | None = None) -> None:
        """End these streams with an error, by default all of them."""
        for stream in self if streams is None else streams:
            stream.fail(error)
            self.remove(stream)

    def _take_result(self, number: int, response: Any) -> None:
        stream = self._requested.pop(number, None)
        if stream is None:
            return
        ended = list(self.of(stream.goal_id))
        if response.status == GoalStatus.UNKNOWN:
            if number == stream.early_request:
                # The server did not know the goal yet.
                stream.requests.remove(number)
                if stream.has_begun:
                    with suppress(ConnectionLost):  # then the stream ends with it
                        self.request_result(stream)
                return
            info = self._known.get(stream.goal_id)
            if stream.has_begun and info is not None and info.status.is_active:
                # Another server has answered, which does not know the goal. Ask again, until the
                # one that has the goal answers.
                self.expect_result(stream.goal_id, LATE)
                return
            ended = [stream]
        for one in ended:
            try:
                one.set_outcome(one.decoder.outcome(response))
            except ProtocolError as exc:
                one.fail(exc)
            is_over = one.is_over or response.status == GoalStatus.UNKNOWN
            if not is_over and one.reads and not one.is_counted:
                one.awaits_rest = True
                self._catch_up(partial(self._take_rest, one))
            if is_over or one.missing == 0:
                self._finish(one)
            else:
                patience = LATE if one.awaits_server else self._patience
                self._unfinished.setdefault(one, current_time() + patience)

    def _take_unanswered(self, number: int) -> None:
        """Request a result again soon: the request has been lost, or its server has gone."""
        with suppress(KeyError):  # it was answered meanwhile
            stream = self._requested.pop(number)
            stream.requests.remove(number)
            self.expect_result(stream.goal_id, 0.0)

    def _take_unreadable(self, error: Exception) -> None:
        """Take a response that cannot be read, so that its request number is not known.

        Readable results come when they are requested. So the response belongs to a goal whose
        result was requested in vain.
        """
        for stream in self:
            if len(stream.requests) - stream.resumed > FAILED_REQUESTS:
                stream.fail(ProtocolError(f"the goal's result cannot be read: {error}"))
                self.remove(stream)
