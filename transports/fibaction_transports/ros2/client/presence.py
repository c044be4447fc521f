"""The presence of an action's servers: by the graph, and by their signs of life."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import anyio

from fibaction.border.event_loop import loop_clock
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ServerNotFound, TransportError
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.client.diagnosis import explain_mismatch, explain_versions
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.parts import ServiceCaller, TopicSubscription
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.settings import RosSettings

LOOK_PAUSE = 0.05
"""Seconds between two looks for a server that is waited for; ROS offers nothing to wait for."""
WATCH_PAUSE = 0.25
"""Seconds between two looks at a server that is in use."""
FIRST_SIGN = 2.0
"""Leases that a server's first sign of life may take. It is sent at once. If it is lost, which
happens on a busy machine, the next one is sent after most of a lease."""
MATCH_TIME = 1.0
"""Seconds after which a server that is in the graph, and is not yet connected, is looked at."""

logger = clean_logger("fibaction.ros2")


class Presence:
    """Tells if an action has a server that can be reached.

    A server that leaves is removed from the graph at once. One that is killed is removed when the
    lease of its node has run out, after about 20 s. Servers of fibaction give signs of life on
    their status topic, too, and count as silent after `lease` seconds without one. With a
    middleware that may tell nothing of signs of life, this begins with the first one that it tells.

    A silent server may be there again: it was stopped, or its line was. So it is missed only after
    a grace time. A server that leaves while it is not silent is missed at once.
    """

    def __init__(
        self,
        ros: RosNode,
        action: str,
        impl: Any,
        full: ActionNames,
        clients: Sequence[ServiceCaller],
        subscriptions: tuple[TopicSubscription, TopicSubscription],
        settings: RosSettings,
    ) -> None:
        """`impl` has the types of the action. `subscriptions` are those to the feedback and to the
        statuses, in this order.
        """
        self._ros = ros
        self._action = action
        self._impl = impl
        self._names = full
        self._clients = clients
        self._subscriptions = subscriptions
        _, self._status = subscriptions
        self._settings = settings
        self._time = loop_clock()
        self._deadline = self._time() + settings.discovery_timeout
        self._alive: int = 0
        self.silent: int = 0
        """The number of servers that are known to be silent."""
        self._dead: bool = False
        self._left: bool = False
        """True if the last server that lived was not among those that fell silent."""
        self._unheard_since = self._looked = self._time()
        self._silent_since: float | None = None
        """The time at which a server was found silent; None if there is one that is not."""
        self._servers: frozenset[bytes] = frozenset()
        self._counted: tuple[int, float] = 0, -math.inf
        self._checked: frozenset[bytes] = frozenset()
        """The servers whose versions of the types are those here."""
        lease = qos.liveliness(settings.lease)
        self._watch = ros.life_watch(full.status, impl.GoalStatusMessage, lease)
        self._tells_signs = ros.tells_signs

    @property
    def lease(self) -> float:
        """Seconds without a sign of life after which a server counts as silent."""
        return self._settings.lease

    def is_there(self) -> bool:
        """Return whether there is a server, and all its parts are connected."""
        return self._ros.is_up and self._look()

    def _look(self) -> bool:
        self._poll_liveliness()
        matched = True
        for subscription in self._subscriptions:
            matched = matched and subscription.publisher_count() > 0
        for client in self._clients:
            matched = matched and client.is_available()
        self._note_look(matched)
        is_silent = self._is_doubted() and self._all_have_leases() if matched else self._ros.is_cut
        if not is_silent and matched:
            self._silent_since = None
        elif self._silent_since is None and is_silent and not self._has_left():
            self._silent_since = self._time()
        return matched and not is_silent

    def _is_doubted(self) -> bool:
        """Return whether no server is known to live, so that there is none if all have leases."""
        return self._dead or (
            self._tells_signs and self._looked - self._unheard_since > FIRST_SIGN * self.lease
        )

    def _has_left(self) -> bool:
        """Return whether a server has left rather than fallen silent, and the graph is late."""
        return self._dead and (self._left or not self.silent)

    def _note_look(self, matched: bool) -> None:
        """Note that a server is there without any sign of life: it may have died before its first
        one. Only an uninterrupted time counts.
        """
        now = self._time()
        if self._alive or not matched or now - self._looked > self.lease:
            self._unheard_since = now
        self._looked = now

    def may_return(self) -> bool:
        """Return whether the last server has fallen silent, and may still be there again."""
        since = self._silent_since
        return since is not None and self._time() - since < self._settings.grace

    def have_gone(self, servers: frozenset[bytes]) -> bool:
        """Return whether none of these servers is there any more, and others are."""
        now = self.servers()
        return bool(servers and now and servers.isdisjoint(now)) and not self._ros.is_cut

    def servers(self) -> frozenset[bytes]:
        """Return the servers, as ROS identifies the ends of the status topic (by GIDs). A server
        that is restarted has another GID.

        They are looked up when their number has changed, or after `WATCH_PAUSE`, and not for each
        of many status lists: a look takes about 0.1 ms.
        """
        now = self._time()
        count = self._status.publisher_count()
        before, then = self._counted
        if count != before or now - then >= WATCH_PAUSE:
            self._counted = count, now
            self._servers = frozenset(one.gid for one in self._ros.publishers(self._names.status))
        return self._servers

    async def needed(self) -> None:
        """Return when there is a server. It is waited for only for `discovery_timeout` seconds
        after the beginning, in which it may still be discovered, and while it may return.

        Raises:
            ServerNotFound: There is no server.
            ConnectionLost: ROS has been shut down.
        """
        while not self.is_there():
            self._ros.raise_if_lost()
            if self._time() >= self._deadline and not self.may_return():
                raise ServerNotFound(self._why_not_found())
            await self._ros.graph_news(LOOK_PAUSE)
        self._deadline = -math.inf  # from now on, a server that leaves is missed at once

    def check_versions(self) -> frozenset[bytes]:
        """Check that the servers have the types that this client has, and return them.

        Raises:
            TransportError: They have other versions of them.
        """
        servers = self.servers()
        if servers != self._checked:
            if problem := self._other_versions():
                raise TransportError(self._unusable(problem))
            self._checked = servers
        return servers

    def _why_not_found(self) -> str:
        if mismatch := self._mismatch():
            return f"cannot reach the action {self._action!r} in ROS: {mismatch}"
        if problem := self._other_versions():
            return self._unusable(problem)
        return (
            f"no server of the action {self._action!r} in ROS: there is no service"
            f" {self._names.send_goal}; start the server, or wait for it with wait_for_server()"
        )

    def _other_versions(self) -> str:
        return explain_versions(self._ros, self._names, self._impl)

    def _unusable(self, problem: str) -> str:
        """Return the error about other versions of the types."""
        self._ros.told.add(problem)
        return f"cannot use the action {self._action!r} in ROS: {problem}"

    def _mismatch(self) -> str:
        return explain_mismatch(self._ros, self._names, self._settings)

    async def come(self) -> None:
        """Wait for a server. If there is one that does not match, the log says so once.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        with anyio.move_on_after(MATCH_TIME) as scope:
            await self._come()
        if scope.cancelled_caught:
            if mismatch := self._mismatch():
                logger.warning("%s cannot be reached yet: %s", self._action, mismatch)
            self._warn_of_versions()
            await self._come()
        self._warn_of_versions()

    def _warn_of_versions(self) -> None:
        problem = self._other_versions()
        if problem and problem not in self._ros.told:
            logger.warning("%s", self._unusable(problem))

    async def _come(self) -> None:
        while not self.is_there():
            self._ros.raise_if_lost()
            await self._ros.graph_news(LOOK_PAUSE)

    def _poll_liveliness(self) -> None:
        news = self._watch.news()
        if news is None:
            return
        # A server that was killed counts among those that do not live until its node's lease ends.
        fell_silent = news.not_alive > self.silent
        self.silent = news.not_alive
        if news.alive != self._alive:
            self._alive, self._dead = news.alive, news.alive == 0
            self._left = self._dead and not fell_silent
            self._tells_signs = True

    def _all_have_leases(self) -> bool:
        """Return whether all servers in the graph give signs of life: those have a short lease."""
        known = self._ros.publishers(self._names.status)
        return all(one.qos.lease < 2 * self.lease for one in known)
