"""The action client: one for each action and node, shared by all endpoints of the action.

Theory of operation
-------------------

An action of ROS is three services and two topics. The client gets the ends of them from a
`RosNode`, and knows nothing of the types of the payloads: `endpoint` converts them.

*Messages arrive* on the event loop, wherever the node takes them. The `_take_...` methods handle
them without waiting. So no state here needs a lock.

*A goal* is sent by a `ServiceClient`, which retries. A retry may be rejected because the first
request was accepted and only its answer was lost: so a rejection counts only if the goal is not in
the status list either. From before the request on, a `RosGoalStream` in `FollowedGoals` is told of
the goal's feedback, its statuses and its result, because the server may send feedback before its
acceptance arrives.

*The end of a goal* is the answer to the request for its result. `FollowedGoals` requests it when
the goal is accepted, or with the goal if the only server is one of fibaction, and again if the
status list says that the goal has ended and the answer is missing.

*Statuses* come in lists of all goals. `StatusLists` finds what has changed, and tells the streams
of all statuses; the streams of the goals are told here.

*A server that has gone* does not say so. `run` looks for the server as long as a call, a goal or a
stream of statuses is pending. `Presence` knows by the graph, and by signs of life, whether there is
a server. If it has fallen silent, it is waited for; when it is there again, requests whose answers
are missing are sent again. If there is none, everything that is pending ends with `ConnectionLost`,
after `RosNode.last_words`, for what is still on its way. A server that was restarted has
another ID (GID) in the graph: goals that were accepted by servers that are all gone end likewise.

*A loss on the way* is noticed only by what is missing: by a timeout (`ServiceClient`), or by the
status list (`FollowedGoals`). Feedback that is late or lost is noticed at the end of the goal, if
its server is one of fibaction, which tells how many messages there were (`ReceivedCounts`). The
stream then waits a while for those that are missing. With another server, only the middleware can
notice it (`TopicSubscription.when_caught_up`); feedback after the stream's end is logged.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import anyio
from anyio import current_time

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.feeds.status_broadcast import StatusSubscription
from fibaction.words.errors import ConnectionLost, GoalRejected, UnknownGoal
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.client.followed_goals import LATE, FollowedGoals
from fibaction_transports.ros2.client.goal_stream import RosGoalStream
from fibaction_transports.ros2.client.presence import WATCH_PAUSE, Presence
from fibaction_transports.ros2.client.service_client import ServiceCall, ServiceClient
from fibaction_transports.ros2.client.status_lists import StatusLists
from fibaction_transports.ros2.convert.conversion import stamp_of
from fibaction_transports.ros2.names import action_names
from fibaction_transports.ros2.node.feedback_counts import ReceivedCounts
from fibaction_transports.ros2.node.rivals import Rivals
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.node.stamps import FollowedStamps
from fibaction_transports.ros2.settings import RosSettings

QUEUE = 10
"""Feedback that the middleware may hold, as a multiple of what a goal keeps for its reader. The
queue holds the feedback of all goals until the thread that takes it gets its turn, which may be
late on a busy machine; most of the time it is empty."""
NO_REASON = "the server rejected it; ROS 2 transmits no reason, but the server's log may have it"

logger = clean_logger("fibaction.ros2")


class RosActionClient:
    """A client of the servers of one action."""

    def __init__(self, ros: RosNode, action: str, impl: Any, settings: RosSettings) -> None:
        """Make the ends of the action at this node.

        Raises:
            TransportError: ROS does not allow them.
        """
        self.impl = impl
        self.types = ros.types
        self.depth = settings.feedback_depth
        """Feedback messages of a goal that are kept for a late reader."""
        self.stamps = FollowedStamps(ros.clock)
        self._lists = StatusLists(self.stamps.from_ros)
        self.known = self._lists.known
        self._action = action
        self._ros = ros
        full, services = action_names(ros.resolve, action), qos.services(settings.services_qos)
        # Subscriptions first. A server that knows the clients then knows these, too, so that its
        # messages arrive once it answers.
        queue = qos.feedback(QUEUE * self.depth, settings.feedback_qos)
        feedback = ros.subscription(full.feedback, impl.FeedbackMessage, queue, self._take_feedback)
        lists = qos.subscribed_status(settings.status_qos)
        status = ros.subscription(full.status, impl.GoalStatusMessage, lists, self._take_statuses)
        self._goals = ServiceClient(ros, full.send_goal, impl.SendGoalService, services)
        self._cancels = ServiceClient(ros, full.cancel_goal, impl.CancelGoalService, services)
        self._followed = FollowedGoals(
            ros,
            action,
            full.get_result,
            impl.GetResultService,
            services,
            self.known,
            is_reliable=qos.are_reliable(settings.feedback_qos),
            catch_up=feedback.when_caught_up,
        )
        feedback.tell_lost(self._followed.note_lost)
        callers = (self._goals.caller, self._cancels.caller, self._followed.results)
        ros.introspect(settings.introspection, *callers)
        self._counts = ReceivedCounts(ros, action, self._followed.take_count)
        self._undecided: list[RosGoalStream] = []
        self._rivals = Rivals(ros, action, full, settings.lease)
        self._was_silent = False
        self._pending = Notifier()
        self.presence = Presence(ros, action, impl, full, callers, (feedback, status), settings)
        ros.on_loss(self._fail)

    # Requests

    async def send(self, stream: RosGoalStream, goal: Any) -> None:
        """Send a goal, which the stream follows from its beginning.

        Raises:
            GoalRejected, ServerNotFound, ConnectionLost: See `Endpoint.offer_goal`.
            TransportError: The server has other versions of the types.
        """
        await self.presence.needed()
        servers = self.presence.check_versions()
        self._rivals.note(servers, len(servers) - self.presence.silent)
        stream.is_counted = self._counts.come_from(servers)
        request = self.impl.SendGoalService.Request()
        request.goal_id.uuid = self.types.uuid(stream.goal_id)
        request.goal = goal
        self._follow(stream)
        try:
            info = await self._accepted(stream, request)
            stream.servers = self.presence.servers()
            stream.ros_stamp = self.stamps.stamp_in_ros(info.goal_id, info.stamp)
            stream.begin(GoalInfo(info.goal_id, info.stamp, GoalStatus.ACCEPTED))
            if (now := self.known.get(stream.goal_id)) is not None:
                stream.set_status(now.status)
            stream.awaits_server = self._rivals.can_be_told_apart
            self._choose_servers([stream])
            if not stream.requests:
                self._followed.request_result(stream)
        except BaseException:
            self._followed.remove(stream)
            raise

    async def _accepted(self, stream: RosGoalStream, request: Any) -> GoalInfo:
        goal_id = stream.goal_id

        def sent() -> None:
            if stream.is_counted:  # so its server is one of fibaction
                stream.early_request = self._followed.request_result(stream)

        with ServiceCall(self._goals, request, sent) as call:
            stream.when_listed = call.hasten
            self._pending.notify()
            while not await call.attempt():
                # If it was the answer that was lost, the goal is in the list.
                if (info := self.known.get(goal_id)) is not None:
                    return info
            if not call.response.accepted and call.tries > 1:
                # The retry was rejected because of the first request.
                await self._listing(goal_id, call)
                if (info := self.known.get(goal_id)) is not None:
                    return info
            response = call.response
        if not response.accepted:
            raise GoalRejected(NO_REASON, goal_id=goal_id)
        stamp = self.stamps.from_ros(goal_id, stamp_of(response.stamp))
        return GoalInfo(goal_id, stamp, GoalStatus.ACCEPTED)

    async def _listing(self, goal_id: GoalID, call: ServiceCall) -> None:
        """Wait a moment until the goal is listed, or another answer accepts it."""
        deadline = current_time() + LATE
        while self.known.get(goal_id) is None and not call.response.accepted:
            if current_time() >= deadline:
                return
            await anyio.sleep(LATE / 10)

    async def follow(self, stream: RosGoalStream) -> None:
        """Let the stream follow a goal that was sent before.

        Raises:
            UnknownGoal, ServerNotFound, ConnectionLost: See `Endpoint.feedback`.
            ProtocolError: The goal has ended, and its result cannot be read.
            TransportError: The server has other versions of the types.
        """
        await self.presence.needed()
        self.presence.check_versions()
        self._forget_gone()
        self._follow(stream)
        try:
            self._followed.request_result(stream)
            if (info := self._followed.active(stream.goal_id)) is not None:
                stream.begin(info)
            else:
                await self._decided(stream)
            stream.servers = self.presence.servers()
        except BaseException:
            self._followed.remove(stream)
            raise

    async def _decided(self, stream: RosGoalStream) -> None:
        """Wait for the answer if the goal has ended, or for a status list if it has not."""
        self._followed.expect_result(stream.goal_id, 2 * LATE)
        self._undecided.append(stream)
        try:
            while not (stream.has_begun or stream.is_over):
                await stream.news.wait()
        finally:
            self._undecided.remove(stream)
        if stream.is_over and (await stream.outcome()).status is GoalStatus.UNKNOWN:
            raise UnknownGoal(stream.goal_id)

    async def cancel(self, request: Any) -> Any:
        """Send a cancel request, and return the answer.

        Raises:
            ServerNotFound, ConnectionLost: See `Endpoint.cancel_goals`.
        """
        await self.presence.needed()
        self._pending.notify()
        return await self._cancels.call(request)

    async def subscribe(self) -> StatusSubscription:
        """Follow the statuses of all goals.

        Raises:
            ServerNotFound, ConnectionLost: See `Endpoint.status`.
        """
        await self.presence.needed()
        self._forget_gone()
        statuses = await self._lists.subscribe()
        self._pending.notify()
        return statuses

    def _choose_servers(self, streams: Iterable[RosGoalStream]) -> None:
        """Take the feedback of each accepted goal from one server, if there are several."""
        for stream in streams:
            publishers = self._rivals.feedback_of(stream.goal_id, stream.ros_stamp)
            self._followed.take_from(stream, publishers)

    def _follow(self, stream: RosGoalStream) -> None:
        self._followed.add(stream)
        self._pending.notify()

    # Messages

    def _take_feedback(self, message: bytes, publisher: bytes) -> None:
        self._followed.take_feedback(message, publisher)

    def _take_statuses(self, message: bytes, publisher: bytes) -> None:
        self._rivals.note_list(publisher, message)
        for info in self._lists.take(message, self.presence.servers()):
            streams = self._followed.of(info.goal_id)
            for stream in streams:
                stream.set_status(info.status)
            if streams and not info.status.is_active:
                self._followed.expect_result(info.goal_id, LATE)
        shared = self._followed if self._rivals.can_be_told_apart else ()
        self._choose_servers(stream for stream in shared if stream.has_begun)
        for stream in self._undecided:
            if (now := self._followed.active(stream.goal_id)) is not None:
                stream.begin(now)

    # Servers that have gone

    async def run(self) -> None:
        """Look after everything that is pending, until canceled."""
        while True:
            while not self._is_pending():
                await self._pending.wait()
            await self._ros.graph_news(WATCH_PAUSE)
            if self._is_pending():
                await self._look_for_server()
            self._followed.retry_overdue()
            self._followed.finish_overdue()

    async def _look_for_server(self) -> None:
        if self.presence.is_there():
            if self._was_silent:
                self._was_silent = False
                self._resume()
            servers = self.presence.servers()
            self._rivals.note(servers, len(servers) - self.presence.silent)
            await self._fail_gone()
        elif self.presence.may_return():
            if not self._was_silent:
                self._was_silent = True
                logger.info("%s: its server is silent, and is waited for", self._action)
        else:
            self._was_silent = False
            await self._ros.last_words()
            # One of two servers may have left: its parts leave the graph one after another, and
            # meanwhile their numbers do not match, as if none was there.
            if not (self.presence.is_there() or self.presence.may_return()):
                self._fail(self._gone())
                self.known.clear()

    def _resume(self) -> None:
        """Request again what may have been lost while the server was silent. If it was started
        again meanwhile, the new one says whether it knows the goals.
        """
        logger.info("%s: its server is there again", self._action)
        for stream in self._followed:
            stream.servers |= self.presence.servers()
        self._followed.resume()
        for client in (self._goals, self._cancels):
            client.resume()

    def _is_pending(self) -> bool:
        calls = self._goals.calls or self._cancels.calls
        return bool(calls or self._followed or self._lists.are_followed)

    def _gone(self) -> ConnectionLost:
        return ConnectionLost(f"the server of {self._action!r} has gone away")

    async def _fail_gone(self) -> None:
        """End the goals of servers that have gone, although others have taken their place, and the
        status lists. After the last words, it is known whether the network was lost instead.
        """
        if self._left() or self.presence.have_gone(self._lists.servers):
            await self._ros.last_words()
            self._forget_gone()
            self._followed.fail(self._gone(), self._left())

    def _left(self) -> list[RosGoalStream]:
        """Return the goals whose servers have gone, although there are others."""
        return [one for one in self._followed if self.presence.have_gone(one.servers)]

    def _forget_gone(self) -> None:
        """Forget the status list of a server that has gone. The server that serves now may never
        send one: servers of rclpy and rclcpp begin with their first goal.
        """
        if self.presence.have_gone(self._lists.servers):
            self._lists.forget()
            self._lists.fail(self._gone())

    def _fail(self, error: ConnectionLost) -> None:
        for client in (self._goals, self._cancels):
            client.fail(error)
        self._followed.fail(error)
        self._lists.fail(error)
