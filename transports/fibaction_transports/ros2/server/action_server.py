"""The action server: an endpoint is served as an action of ROS.

Theory of operation
-------------------

An action of ROS is three services and two topics, as in `rcl_action`. The server gets
the ends of them from a `RosNode`. It calls the methods of an `Endpoint`, so it serves an action
server of this process as well as one that a gateway reaches.

*Requests* are answered by `ServiceServers`, each in a task of its own. A goal goes to the endpoint,
which accepts or rejects it. The reason of a rejection has no field in ROS's answer, so it is
written to the log of ROS. While a goal is being decided, a second request with its ID waits; later
it is rejected, as rcl_action does it.

*Each goal* has a `GoalForwarder`, which follows the endpoint's stream of the goal. It publishes the
feedback on the `FeedbackTopic`, updates the status list, and answers requests for the result. The
order is: the acceptance is answered, then feedback is published, then the number of its messages
(`PublishedCounts`, for clients of fibaction), then the terminal status, then the result. For a goal
that did not come through ROS, for instance over another transport, a forwarder is started when the
stream of all statuses tells of it.

*Statuses* come from two sources: from the stream of each goal, and from the endpoint's stream of
all statuses, which may be read later. `ServedStatuses` ignores what is older than what it has.
The stream of all statuses is needed for goals that did not come through ROS, for `CANCELING`, and
for `UNKNOWN`, which removes a forgotten goal from the list. Statuses after the end are kept in
`GoalForwarder.late` until the goal's feedback and result are out.

*The end.* `drain` waits until everything is answered that can be answered, then the node stays for
another `LINGER` seconds: Fast DDS drops what has arrived and is not yet handled, if it hears first
that the sender has left.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Sequence
from contextlib import asynccontextmanager
from typing import Any, TypeAlias

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalStream, Notifier
from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ActionError, GoalRejected, ProtocolError
from fibaction.words.goals import (
    UNKNOWN_OUTCOME,
    CancelAnswer,
    CancelCode,
    GoalID,
    GoalInfo,
    Outcome,
)
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.convert.conversion import RosCodecs, goal_id_of, stamp_of
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.feedback_counts import PublishedCounts
from fibaction_transports.ros2.node.rivals import warn_of_rivals
from fibaction_transports.ros2.node.ros_node import EndpointInRos, RosNode, RosTypes
from fibaction_transports.ros2.node.stamps import ServedStamps
from fibaction_transports.ros2.server.goal_forwarder import (
    FeedbackPublisher,
    FeedbackTopic,
    GoalForwarder,
)
from fibaction_transports.ros2.server.served_statuses import ServedStatuses
from fibaction_transports.ros2.server.service_server import ServiceServers
from fibaction_transports.ros2.settings import RosSettings

NO_GOAL = bytes(16)
DRAIN_TIMEOUT = 5.0
"""Seconds that leaving waits for the last answers to be sent."""
ASKING_TIME = 0.5
"""Seconds of these in which clients may still ask for results: a client that has just been told
that its goal was accepted is about to."""
LINGER = 0.2
"""Seconds that the node stays after the last message was sent."""
RETRY_PAUSE = 1.0
"""Seconds between attempts to follow the statuses of an endpoint that cannot be reached."""

logger = clean_logger("fibaction.ros2")


_Forwarded: TypeAlias = tuple[GoalID, GoalForwarder, FeedbackPublisher]


class ServedEndpoint:
    """An endpoint, and the ROS type of its action, which is looked up before anything is served."""

    def __init__(self, endpoint: Endpoint, types: RosTypes) -> None:
        """Find the action's type in ROS.

        Raises:
            TransportError: There is no such type, or its fields do not match the action's.
        """
        self.endpoint = endpoint
        info, inner = endpoint.info, endpoint
        while isinstance(inner, ForwardingEndpoint):
            inner = inner.inner
        if isinstance(inner, EndpointInRos) and types.can_serve(inner.ros_action):
            found = inner.ros_action  # as another robot has told it, which may be in no file here
        else:
            found = types.find(info.type_name, info.name)
        self.impl: Any = found.impl
        self.codecs: RosCodecs = found.codecs(info)


class RosActionServer:
    """One action, served in ROS."""

    def __init__(
        self, ros: RosNode, served: ServedEndpoint, settings: RosSettings, tasks: TaskGroup
    ) -> None:
        self._ros = ros
        self._endpoint = served.endpoint
        self._impl = served.impl
        self._codecs = served.codecs
        self._tasks = tasks
        self._name = served.endpoint.info.name
        self._names = action_names(ros.resolve, self._name)
        self._deciding: set[GoalID] = set()
        self._accepted: dict[GoalID, _Forwarded] = {}
        """The goals whose acceptance is being answered; the task of each request then continues
        with the goal."""
        self._forwarders: dict[GoalID, GoalForwarder] = {}
        self._progress = Notifier()
        services = qos.services(settings.services_qos)
        self._services = ServiceServers(ros, self._name, services, tasks, self._progress)
        self._open(settings)

    def _open(self, settings: RosSettings) -> None:
        impl, full, serve = self._impl, self._names, self._services.serve
        rejected = impl.CancelGoalService.Response(return_code=int(CancelCode.REJECTED))

        def decided(request: Any) -> None:
            goal_id = goal_id_of(request.goal_id)
            self._deciding.discard(goal_id)
            self._statuses.repeat_later(goal_id)

        def follow(request: Any) -> Awaitable[None] | None:
            accepted = self._accepted.pop(goal_id_of(request.goal_id), None)
            return None if accepted is None else self._run_forwarder(*accepted)

        self._ros.introspect(
            settings.introspection,
            serve(
                full.send_goal,
                impl.SendGoalService,
                self._answer_goal,
                done=decided,
                follow=follow,
            ),
            serve(full.cancel_goal, impl.CancelGoalService, self._answer_cancel, failure=rejected),
            serve(full.get_result, impl.GetResultService, self._answer_result, is_awaited=False),
        )
        # Before the rest: a client that knows the server then knows that it publishes these, too.
        self._counts = PublishedCounts(self._ros, self._name)
        self._feedback = FeedbackTopic(
            self._ros, self._name, full, impl.FeedbackMessage, self._codecs.feedback, settings
        )
        profile = qos.published_status(settings.lease, settings.status_qos)
        publisher = self._ros.publisher(full.status, impl.GoalStatusMessage, profile)
        stamps = ServedStamps(self._ros.clock)
        self._statuses = ServedStatuses(publisher.publish_bytes, stamps)

    def start(self) -> None:
        """Serve."""
        tasks, name, topic = self._tasks, self._name, self._names.status
        self._statuses.start(tasks, name)
        tasks.start_soon(self._follow_statuses, name=f"goals of {name}")
        tasks.start_soon(warn_of_rivals, self._ros, name, topic, name=f"rivals of {name}")

    async def drain(self) -> None:
        """Wait until everything has been answered that can be answered."""
        if self._services.is_closed:
            return
        with anyio.move_on_after(DRAIN_TIMEOUT, shield=True):
            with anyio.move_on_after(ASKING_TIME):
                await self._all_sent()
            for forwarder in self._forwarders.values():
                forwarder.hurry()
            await self._all_sent()
            self._statuses.flush()
        self._services.close()

    async def _all_sent(self) -> None:
        while self._services.is_busy or any(one.is_owed for one in self._forwarders.values()):
            await self._progress.wait()

    @property
    def sent_at(self) -> float:
        """The time at which the last answer or status list was sent."""
        return max(self._statuses.published_at, self._services.sent_at)

    # Requests

    async def _answer_goal(self, request: Any) -> Any:
        response = self._impl.SendGoalService.Response()
        goal_id = goal_id_of(request.goal_id)
        try:
            stamp = await self._accept(goal_id, request.goal)
        except ActionError as exc:
            reason = exc.reason if isinstance(exc, GoalRejected) else str(exc)
            self._ros.warn(f"{self._name}: goal {goal_id} rejected: {reason}")
            return response
        if stamp is None:
            logger.info("%s: goal %s was sent again, and was decided before", self._name, goal_id)
        else:
            response.accepted = True
            response.stamp.sec, response.stamp.nanosec = divmod(stamp, 10**9)
        return response

    async def _accept(self, goal_id: GoalID, goal: Any) -> int | None:
        """Offer a goal, and return its stamp in ROS; None if one with its ID was accepted before.

        Raises:
            ActionError: It is not accepted.
        """
        while goal_id in self._deciding:
            # A client sends it again, or two goals clash: the first answer counts.
            await self._progress.wait()
        if goal_id in self._forwarders or goal_id in self._statuses:
            return None
        self._deciding.add(goal_id)  # until the client has been told
        payload = self._codecs.goal.from_ros(goal)
        stream = await self._endpoint.send_goal(goal_id, payload, checked=True)
        # Here and not only by the stream of all statuses, which may be read after the goal's own.
        self._statuses.update(GoalInfo(goal_id, stream.stamp, GoalStatus.ACCEPTED))
        self._accepted[goal_id] = self._forwarded(stream)
        return self._statuses.stamps.to_ros(goal_id, stream.stamp)

    async def _answer_cancel(self, request: Any) -> Any:
        info = request.goal_info
        goal_id, stamp = goal_id_of(info.goal_id), stamp_of(info.stamp)
        try:
            answer = await self._endpoint.cancel_goals(
                None if goal_id == NO_GOAL else goal_id,
                self._statuses.stamps.from_ros(stamp) if stamp else None,
            )
        except ActionError as exc:
            answer = CancelAnswer(CancelCode.REJECTED, reason=str(exc))
        if answer.reason:
            self._ros.warn(f"{self._name}: cancel rejected: {answer.reason}")
        await anyio.lowlevel.checkpoint()  # statuses from before the cancel are published first
        for one in answer.goals_canceling:
            self._statuses.update(one)
        self._statuses.publish_if_due()
        response = self._impl.CancelGoalService.Response()
        response.return_code = int(answer.return_code)
        canceling = [self._statuses.in_ros(one) for one in answer.goals_canceling]
        response.goals_canceling = [goal_info_to_ros(self._ros.types, one) for one in canceling]
        return response

    async def _answer_result(self, request: Any) -> Any:
        goal_id = goal_id_of(request.goal_id)
        if goal_id not in self._forwarders:
            # Clients of fibaction send this right after the goal itself, which is to begin first.
            await anyio.lowlevel.checkpoint()
            while goal_id in self._deciding and goal_id not in self._forwarders:
                await self._progress.wait()
        forwarder = self._forwarders.get(goal_id)
        if forwarder is not None:
            response = await forwarder.answer()
            # First, and in a later turn than the end: one list tells the ends of all of its turn.
            self._statuses.publish_if_due()
            return response
        try:
            outcome = await self._endpoint.get_result(goal_id)
        except ActionError as exc:  # a gateway has lost the server behind it
            logger.info("%s: no result of goal %s: %s", self._name, goal_id, exc)
            outcome = UNKNOWN_OUTCOME
        return self._result(goal_id, outcome)

    def _result(self, goal_id: GoalID, outcome: Outcome[bytes]) -> Any:
        response = self._impl.GetResultService.Response()
        status = outcome.status
        try:
            response.result = self._codecs.result.to_ros(outcome.result)
        except ProtocolError as exc:
            self._ros.complain(
                f"{self._name}: goal {goal_id} aborted: its result does not fit its ROS type: {exc}"
            )
            status = GoalStatus.ABORTED
        response.status = int(status)
        return response

    # Goals

    def _forwarded(self, stream: GoalStream) -> _Forwarded:
        """Note that a goal is forwarded from now on; `_run_forwarder` does it."""
        goal_id = stream.goal_id
        feedback = self._feedback.of(goal_id)
        forwarder = GoalForwarder(stream, feedback.publish, self._statuses.update)
        self._forwarders[goal_id] = forwarder
        return goal_id, forwarder, feedback

    async def _run_forwarder(
        self, goal_id: GoalID, forwarder: GoalForwarder, feedback: FeedbackPublisher
    ) -> None:
        try:
            # A goal that ends at once has ended then, and everything is taken by one look.
            await anyio.lowlevel.checkpoint()
            try:
                outcome = await forwarder.outcome()
            except Exception as exc:
                self._log_failure(f"goal {goal_id} is lost", exc)
                outcome = Outcome[bytes](GoalStatus.UNKNOWN)  # the reason has just been logged
            if outcome.reason:
                self._ros.warn(
                    f"{self._name}: goal {goal_id} {outcome.status.name}: {outcome.reason}"
                )
            self._counts.publish(goal_id, feedback.count)
            response = self._result(goal_id, outcome)
            status = GoalStatus(response.status)
            if status.is_terminal:
                self._statuses.update(GoalInfo(goal_id, forwarder.stream.stamp, status))
            await forwarder.hand_over(response)
        finally:
            self._forwarders.pop(goal_id, None)
            for info in forwarder.late:
                if info.status is GoalStatus.UNKNOWN or goal_id not in self._statuses:
                    self._statuses.update(info)
            self._progress.notify()

    # Statuses

    async def _follow_statuses(self) -> None:
        while True:
            try:
                with await self._endpoint.status() as statuses:
                    while (info := await statuses.receive()) is not None:
                        self._take_status(info)
            except Exception as exc:
                self._log_failure("no statuses", exc)
                self._statuses.clear()
            await anyio.sleep(RETRY_PAUSE)

    def _take_status(self, info: GoalInfo) -> None:
        forwarder = self._forwarders.get(info.goal_id)
        if forwarder is not None and not info.status.is_active:
            forwarder.late.append(info)
            return
        is_new = info.goal_id not in self._statuses and info.goal_id not in self._deciding
        if forwarder is None and is_new and info.status.is_active:
            self._tasks.start_soon(self._follow, info.goal_id, name=f"goal of {self._name}")
        self._statuses.update(info)

    async def _follow(self, goal_id: GoalID) -> None:
        """Publish the feedback of a goal that did not come through ROS."""
        try:
            stream = await self._endpoint.feedback(goal_id)
        except Exception as exc:
            self._log_failure(f"no feedback of goal {goal_id}", exc)
        else:
            if goal_id in self._forwarders:  # its status was told anew, or it came through ROS
                stream.close()
            else:
                await self._run_forwarder(*self._forwarded(stream))

    def _log_failure(self, what: str, exc: Exception) -> None:
        """Log an exception of the endpoint. One that is not an `ActionError` is a bug of the
        endpoint, which must not end the other tasks.
        """
        if isinstance(exc, ActionError):
            logger.info("%s: %s: %s", self._name, what, exc)
        else:
            logger.error("%s: %s: %s", self._name, what, exc, exc_info=exc)


@asynccontextmanager
async def serve_actions(
    ros: RosNode, endpoints: Sequence[ServedEndpoint], settings: RosSettings
) -> AsyncGenerator[None, None]:
    """Serve for as long as the block lasts."""
    async with Background() as tasks:
        servers = [RosActionServer(ros, one, settings, tasks) for one in endpoints]
        for server in servers:
            server.start()
        try:
            yield
        finally:
            for server in servers:
                await server.drain()
            last = max(server.sent_at for server in servers)
            with anyio.CancelScope(shield=True):
                await anyio.sleep_until(last + LINGER)


def goal_info_to_ros(types: RosTypes, info: GoalInfo) -> Any:
    """Return the `action_msgs/msg/GoalInfo` of a goal. It has no field for the status."""
    message = types.GoalInfo()
    message.goal_id.uuid = types.uuid(info.goal_id)
    message.stamp.sec, message.stamp.nanosec = divmod(info.stamp, 10**9)
    return message
