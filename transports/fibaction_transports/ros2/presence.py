"""The presence of an action's servers: by the graph, and by their signs of life."""

from __future__ import annotations

import math
from typing import Any

import anyio
from anyio import current_time

from fibaction._log import clean_logger
from fibaction.exceptions import ConnectionLost, ServerNotFound
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.rcl import LIVELINESS_CHANGED, raw

LOOK_PAUSE = 0.05
"""Seconds between two looks for a server that is waited for; ROS offers nothing to wait for."""
WATCH_PAUSE = 0.25
"""Seconds between two looks at a server that is in use."""
FIRST_SIGN = 2 * qos.LEASE
"""Seconds that a server's first sign of life may take. It is sent at once. If it is lost, which
happens on a busy machine, the next one is sent after most of a lease."""
RIVALS_PAUSE = 1.0
"""Seconds between two looks for a second server of the same name."""

logger = clean_logger("fibaction.ros2")


class Presence:
    """Tells if an action has a server that can be reached.

    A server that leaves is removed from the graph at once. One that is killed is removed when the
    lease of its node has run out, after some 20 s. Servers of fibaction give signs of life on their
    status topic, too, and count as dead after `qos.LEASE` seconds without one.
    """

    def __init__(
        self,
        ros: RosNode,
        action: str,
        status_type: Any,
        full: ActionNames,
        clients: tuple[Any, ...],
        subscriptions: tuple[Any, Any],
        discovery_timeout: float,
    ) -> None:
        """`subscriptions` are those to the feedback and to the statuses, in this order."""
        self._ros = ros
        self._action = action
        self._names = full
        self._clients = clients
        self._subscriptions = subscriptions
        _, self._status = subscriptions
        self._timeout = discovery_timeout
        self._deadline = current_time() + discovery_timeout
        self._alive: int = 0
        self._dead: bool = False
        self._silent_since = self._looked = current_time()
        self._servers: frozenset[bytes] = frozenset()
        self._counted: tuple[int, float] = 0, -math.inf
        subscription = ros.make(raw.Subscription, status_type, full.status, qos.liveliness())
        with subscription:
            self._event = ros.keep(raw.EventHandle(subscription, LIVELINESS_CHANGED))

    def is_there(self) -> bool:
        """Return whether there is a server, and all its parts are connected."""
        there: bool = self._ros.is_up and self._ros.attempt(self._look, otherwise=False)
        return there

    def _look(self) -> bool:
        self._poll_liveliness()
        matched = all(one.get_publisher_count() for one in self._subscriptions) and all(
            client.service_server_is_available() for client in self._clients
        )
        doubted = self._is_silent(matched) or self._dead
        return matched and not (doubted and self._all_have_leases())

    def _is_silent(self, matched: bool) -> bool:
        """Return whether a server has been there for a while without any sign of life: it may have
        died before its first one. Only an uninterrupted time counts.
        """
        now = current_time()
        if self._alive or not matched or now - self._looked > qos.LEASE:
            self._silent_since = now
        self._looked = now
        return now - self._silent_since > FIRST_SIGN

    def servers(self) -> frozenset[bytes]:
        """Return the servers, as ROS identifies the ends of the status topic (by GIDs). A server
        that is started anew has another GID.

        They are looked up when their number has changed, or after `WATCH_PAUSE`, and not for each
        of many status lists: a look takes some 0.1 ms.
        """
        now = current_time()
        count: int = self._ros.attempt(self._status.get_publisher_count, otherwise=0)
        before, then = self._counted
        if count != before or now - then >= WATCH_PAUSE:
            self._counted = count, now
            known = self._ros.attempt(
                self._ros.node.get_publishers_info_by_topic, self._names.status, otherwise=()
            )
            self._servers = frozenset(bytes(one.endpoint_gid) for one in known)
        return self._servers

    async def needed(self) -> None:
        """Return when there is a server. It is waited for only for `discovery_timeout` seconds
        after the beginning, in which it may still be discovered.

        Raises:
            ServerNotFound: There is no server.
            ConnectionLost: ROS has been shut down.
        """
        while not self.is_there():
            self._check_ros()
            if current_time() >= self._deadline:
                raise ServerNotFound(
                    f"no server of the action {self._action!r} in ROS: there is no service"
                    f" {self._names.send_goal}; start the server, or"
                    f" wait for it with wait_for_server()"
                )
            await anyio.sleep(LOOK_PAUSE)
        self._deadline = -math.inf  # from now on, a server that leaves is missed at once

    async def come(self) -> None:
        """Wait for a server.

        Raises:
            ConnectionLost: ROS has been shut down.
        """
        while not self.is_there():
            self._check_ros()
            await anyio.sleep(LOOK_PAUSE)

    def _check_ros(self) -> None:
        if not self._ros.is_up:
            raise ConnectionLost(str(self._ros.error))

    def _poll_liveliness(self) -> None:
        # The event is polled, because the middleware would also wake those that wait for it at
        # every status list.
        event = self._event.take_event()
        alive: int = self._alive if event is None else event.alive_count
        if alive != self._alive:
            self._alive, self._dead = alive, alive == 0

    def _all_have_leases(self) -> bool:
        """Return whether all servers in the graph give signs of life: those have a short lease."""
        known = self._ros.node.get_publishers_info_by_topic(self._names.status)
        longest = int(2 * qos.LEASE * 1e9)
        return all(one.qos_profile.liveliness_lease_duration.nanoseconds < longest for one in known)


async def warn_of_rivals(ros: RosNode, action: str, status_topic: str) -> None:
    """Log a warning whenever a second server of the action appears, until ROS is shut down."""
    warned = False
    while ros.is_up:  # this look is also how a shutdown is noticed
        await anyio.sleep(RIVALS_PAUSE)
        count = ros.attempt(ros.node.count_publishers, status_topic, otherwise=0)
        rivals = count > 1
        if rivals and not warned:
            text = f"{action}: another server serves it too, and ROS runs every goal twice"
            logger.warning("%s", text)
            ros.warn(text)
        warned = rivals
