"""An action server of ROS, as one node of ours sees it: everything but the types of the payloads.

All endpoints of an action share it. What arrives is told to the streams; what is asked is asked
with patience, because what is lost is only noticed by its absence.
"""

from __future__ import annotations

import logging
from typing import Any

import anyio
from anyio import current_time

from fibaction._notify import Notifier
from fibaction.exceptions import ConnectionLost, GoalRejected, ProtocolError, UnknownGoal
from fibaction.goals import GoalID, GoalInfo
from fibaction.server.status_broadcast import StatusSubscription
from fibaction.states import GoalStatus
from fibaction_transports.ros2 import names
from fibaction_transports.ros2.asking import Asker, Question, sent
from fibaction_transports.ros2.cdr import goal_of_feedback
from fibaction_transports.ros2.following import RosGoal
from fibaction_transports.ros2.intake import Messages, Responses
from fibaction_transports.ros2.known import KnownGoals
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.presence import WATCH_PAUSE, Presence
from fibaction_transports.ros2.rcl import raw, uuid_of

QUEUE = 10
"""How many times more feedback the middleware may hold than a goal keeps for its reader. It holds
that of all goals, until the thread that takes it gets its turn, which may come late on a busy
machine; most of the time it is empty."""
LATE = 0.5
"""Seconds after which a result that should be there is asked for again."""
IN_VAIN = 2
"""How often a result is asked for in vain before one that came and cannot be read may be it."""
FIRST_LIST = 1.0
"""Seconds that the first status list may take to come, if there is one: a server of others that
has never had a goal has published none."""
LAST_WORDS = 0.25
"""Seconds that what a server has sent before it left may still take to arrive."""
NO_REASON = "the server rejected it; ROS 2 transmits no reason, but the server's log may have it"

logger = logging.getLogger("fibaction.ros2")


class RemoteServer:
    """Talks to the servers of one action."""

    def __init__(
        self,
        ros: RosNode,
        action: str,
        impl: Any,
        *,
        feedback_depth: int,
        discovery_timeout: float,
    ) -> None:
        """Make the handles of a client.

        Raises:
            TransportError: ROS does not allow them.
        """
        self.impl = impl
        self.depth = feedback_depth
        """How much feedback of a goal is kept for a reader who is late."""
        self.known = KnownGoals()
        self._action = action
        self._ros = ros
        full = names.action_names(ros.node, action)
        make, services = ros.make, names.services()
        # Subscriptions first: whoever knows the clients then knows them, too, so that a server
        # which answers can also be heard.
        queue = names.feedback(QUEUE * feedback_depth)
        feedback = make(raw.Subscription, impl.FeedbackMessage, full.feedback, queue)
        status = make(
            raw.Subscription, impl.GoalStatusMessage, full.status, names.subscribed_status()
        )
        goals = make(raw.Client, impl.SendGoalService, full.send_goal, services)
        cancels = make(raw.Client, impl.CancelGoalService, full.cancel_goal, services)
        self._results = make(raw.Client, impl.GetResultService, full.get_result, services)
        self._goals = Asker(goals, impl.SendGoalService)
        self._cancels = Asker(cancels, impl.CancelGoalService)
        self._asked: dict[int, RosGoal] = {}
        self._streams: dict[bytes, list[RosGoal]] = {}
        self._attaching: list[RosGoal] = []
        self._watchers: list[StatusSubscription] = []
        self._told_by: frozenset[bytes] = frozenset()
        """Who served when the last status list came: one of them has sent it."""
        self._overdue: dict[GoalID, float] = {}
        self._pending = Notifier()
        self._listed = Notifier()
        self.presence = Presence(
            ros,
            action,
            impl.GoalStatusMessage,
            full,
            (goals, cancels, self._results),
            (feedback, status),
            discovery_timeout,
        )
        ros.on_loss(self._fail)
        ros.listen(
            Messages(feedback, impl.FeedbackMessage, self._take_feedback),
            Messages(status, impl.GoalStatusMessage, self._take_statuses),
            self._goals.source,
            self._cancels.source,
            Responses(self._results, impl.GetResultService, self._take_result, self._miss_result),
        )

    # What is asked

    async def send(self, stream: RosGoal, goal: Any) -> None:
        """Send a goal, and let a stream follow it from its beginning.

        Raises:
            GoalRejected, ServerNotFound, ConnectionLost: See `Endpoint.send_goal`.
        """
        await self.presence.needed()
        request = self.impl.SendGoalService.Request()
        request.goal_id.uuid = uuid_of(stream.goal_id)
        request.goal = goal
        self._follow(stream)
        try:
            info = await self._accepted(stream.goal_id, request)
            stream.servers = self.presence.servers()
            stream.begin(GoalInfo(info.goal_id, info.stamp, GoalStatus.ACCEPTED))
            if (now := self.known.get(stream.goal_id)) is not None:
                stream.tell(now.status)
            self._ask_result(stream)
        except BaseException:
            self._unfollow(stream)
            raise

    async def _accepted(self, goal_id: GoalID, request: Any) -> GoalInfo:
        with Question(self._goals, request) as question:
            self._pending.notify()
            while not await question.ask():
                # Lost is the question or the answer; if it is the answer, the goal is in the list.
                if (info := self.known.get(goal_id)) is not None:
                    return info
            if not question.response.accepted and question.tries > 1:
                # The second was refused because of the first.
                await self._appearance(goal_id, question)
                if (info := self.known.get(goal_id)) is not None:
                    return info
            response = question.response
        if not response.accepted:
            raise GoalRejected(NO_REASON, goal_id=goal_id)
        stamp = response.stamp.sec * 10**9 + response.stamp.nanosec
        return GoalInfo(goal_id, stamp, GoalStatus.ACCEPTED)

    async def _appearance(self, goal_id: GoalID, question: Question) -> None:
        deadline = current_time() + LATE
        while self.known.get(goal_id) is None and not question.response.accepted:
            if current_time() >= deadline:
                return
            await anyio.sleep(LATE / 10)

    async def attach(self, stream: RosGoal) -> None:
        """Let a stream follow a goal that was sent before.

        Raises:
            UnknownGoal, ServerNotFound, ConnectionLost: See `Endpoint.feedback`.
            ProtocolError: The goal has ended, and its result cannot be read.
        """
        await self.presence.needed()
        self._forget_gone()
        self._follow(stream)
        try:
            self._ask_result(stream)
            info = self.known.get(stream.goal_id)
            if info is not None and info.status.is_active:
                stream.begin(info)
            else:
                await self._decided(stream)
            stream.servers = self.presence.servers()
        except BaseException:
            self._unfollow(stream)
            raise

    async def _decided(self, stream: RosGoal) -> None:
        """Wait for the answer of a goal that has ended, or for the list with one that has not."""
        self._overdue.setdefault(stream.goal_id, current_time() + 2 * LATE)
        self._attaching.append(stream)
        try:
            while not (stream.has_begun or stream.is_over):
                await stream.news.wait()
        finally:
            self._attaching.remove(stream)
        if stream.is_over and (await stream.outcome()).status is GoalStatus.UNKNOWN:
            raise UnknownGoal(stream.goal_id)

    async def cancel(self, request: Any) -> Any:
        """Ask to cancel.

        Raises:
            ServerNotFound, ConnectionLost: See `Endpoint.cancel_goals`.
        """
        await self.presence.needed()
        self._pending.notify()
        return await self._cancels.ask(request)

    async def watch(self) -> StatusSubscription:
        """Follow the statuses of all goals.

        Raises:
            ServerNotFound, ConnectionLost: See `Endpoint.status`.
        """
        await self.presence.needed()
        self._forget_gone()
        with anyio.move_on_after(FIRST_LIST):
            while not self.known.has_come:
                await self._listed.wait()
        statuses = StatusSubscription(self.known, self._leave)
        self._watchers.append(statuses)
        self._pending.notify()
        return statuses

    def _leave(self, statuses: StatusSubscription) -> None:
        if statuses in self._watchers:
            self._watchers.remove(statuses)

    # Streams

    def _follow(self, stream: RosGoal) -> None:
        self._streams.setdefault(stream.goal_id, []).append(stream)
        self._pending.notify()

    def _unfollow(self, stream: RosGoal) -> None:
        streams = self._streams.get(stream.goal_id, [])
        if stream in streams:
            streams.remove(stream)
        for number in stream.asked:
            self._asked.pop(number, None)
        if not streams:
            self._streams.pop(stream.goal_id, None)
            self._overdue.pop(stream.goal_id, None)

    def _ask_result(self, stream: RosGoal) -> None:
        request = self.impl.GetResultService.Request()
        request.goal_id.uuid = uuid_of(stream.goal_id)
        number = sent(self._results, request)
        stream.asked.append(number)
        self._asked[number] = stream

    # What arrives

    def _take_feedback(self, message: bytes) -> None:
        for stream in self._streams.get(goal_of_feedback(message), ()):
            stream.arrive(message)

    def _take_statuses(self, message: bytes) -> None:
        self._told_by = self.presence.servers()
        for info in self.known.update(message):
            for statuses in self._watchers:
                statuses.put(info)
            streams = self._streams.get(info.goal_id, ())
            for stream in streams:
                stream.tell(info.status)
            if streams and not info.status.is_active:
                self._overdue.setdefault(info.goal_id, current_time() + LATE)
        self._listed.notify()
        for stream in self._attaching:
            if (now := self.known.get(stream.goal_id)) is not None and now.status.is_active:
                stream.begin(now)

    def _take_result(self, item: Any) -> None:
        number, response = item
        stream = self._asked.pop(number, None)
        if stream is None:
            return
        followers = list(self._streams.get(stream.goal_id, ()))
        if response.status == GoalStatus.UNKNOWN:
            info = self.known.get(stream.goal_id)
            if stream.has_begun and info is not None and info.status.is_active:
                # It is another server that does not know it: ask the one that does.
                self._overdue.setdefault(stream.goal_id, current_time() + LATE)
                return
            followers = [stream]
        for follower in followers:
            try:
                follower.end(follower.reading.outcome(response))
            except ProtocolError as exc:
                follower.fail(exc)
            self._unfollow(follower)

    def _miss_result(self, error: Exception) -> None:
        """A result has come that cannot be read. Nobody can say whose it is; but those that can be
        read come when they are asked for, so it is one of those that were asked for in vain.
        """
        for followers in tuple(self._streams.values()):
            for stream in tuple(followers):
                if len(stream.asked) > IN_VAIN:
                    stream.fail(ProtocolError(f"the goal's result cannot be read: {error}"))
                    self._unfollow(stream)

    # Whether there is anybody

    async def run(self) -> None:
        """Look after what is under way, for ever."""
        while True:
            while not self._is_pending():
                await self._pending.wait()
            await anyio.sleep(WATCH_PAUSE)
            if self._is_pending():
                if not self.presence.is_there():
                    await anyio.sleep(LAST_WORDS)
                    self._fail(self._gone())
                    self.known.clear()
                else:
                    await self._leave_gone()
            self._ask_again()

    def _gone(self) -> ConnectionLost:
        return ConnectionLost(f"the server of {self._action!r} has gone away")

    async def _leave_gone(self) -> None:
        """Wait no longer for servers that have gone, although others have taken their place."""
        self._forget_gone()
        left = [
            stream
            for followers in self._streams.values()
            for stream in followers
            if self._has_gone(stream.servers)
        ]
        if left:
            await anyio.sleep(LAST_WORDS)
            for stream in left:
                stream.fail(self._gone())
                self._unfollow(stream)

    def _forget_gone(self) -> None:
        """A status list that is left of a server which has gone says nothing any more. The server
        that serves now may never send one: those of others begin with their first goal.
        """
        if self._has_gone(self._told_by):
            self._told_by = frozenset()
            self.known.clear()
            self._fail_watchers(self._gone())

    def _has_gone(self, servers: frozenset[bytes]) -> bool:
        now = self.presence.servers()
        return bool(servers and now and servers.isdisjoint(now))

    def _is_pending(self) -> bool:
        asking = self._goals.questions or self._cancels.questions
        return bool(asking or self._streams or self._watchers)

    def _ask_again(self) -> None:
        now = current_time()
        for goal_id, when in tuple(self._overdue.items()):
            if when <= now:
                del self._overdue[goal_id]
                for stream in self._streams.get(goal_id, ()):
                    logger.info(
                        "%s: the result of goal %s is asked for again", self._action, goal_id
                    )
                    self._overdue[goal_id] = now + LATE
                    self._ask_result(stream)

    def _fail(self, error: ConnectionLost) -> None:
        for asker in (self._goals, self._cancels):
            asker.fail(error)
        streams, self._streams = self._streams, {}
        for followers in streams.values():
            for stream in followers:
                stream.fail(error)
        self._fail_watchers(error)
        self._asked.clear()
        self._overdue.clear()

    def _fail_watchers(self, error: ConnectionLost) -> None:
        for statuses in self._watchers:
            statuses.fail(error)
        self._watchers.clear()

    def close(self) -> None:
        """Let nobody wait any longer."""
        self._fail(ConnectionLost("the connection was closed here"))
