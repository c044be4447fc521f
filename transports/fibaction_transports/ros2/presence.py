"""Whether there is a server of an action: by the graph, and by its signs of life."""

from __future__ import annotations

import math
from typing import Any

import anyio
from anyio import current_time

from fibaction.exceptions import ConnectionLost, ServerNotFound
from fibaction_transports.ros2 import names
from fibaction_transports.ros2.node import RosNode
from fibaction_transports.ros2.rcl import LIVELINESS_CHANGED, raw

LOOK_PAUSE = 0.05
"""Seconds between two looks for a server that is waited for; ROS offers nothing to wait on."""
WATCH_PAUSE = 0.25
"""Seconds between two looks whether a server is still there."""
FIRST_SIGN = 2 * names.LEASE
"""Seconds that the first sign of life of a server may take. It comes at once; but one that is lost
on a busy machine comes again only after most of a lease."""


class Presence:
    """Knows whether an action's server can be reached.

    A server that leaves is taken from the graph at once, one that is killed only after the lease
    of its node, some 20 s. Servers of fibaction give signs of life on their status topic, too,
    and are missed after `names.LEASE`.
    """

    def __init__(
        self,
        ros: RosNode,
        action: str,
        status_type: Any,
        full: names.ActionNames,
        clients: tuple[Any, ...],
        subscriptions: tuple[Any, Any],
        discovery_timeout: float,
    ) -> None:
        """`subscriptions` are those to the feedback and to the statuses."""
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
        subscription = ros.make(raw.Subscription, status_type, full.status, names.liveliness())
        with subscription:
            self._event = ros.keep(raw.EventHandle(subscription, LIVELINESS_CHANGED))

    def is_there(self) -> bool:
        """Whether there is a server, and all its parts are connected."""
        there: bool = self._ros.is_up and self._ros.attempt(self._look, otherwise=False)
        return there

    def _look(self) -> bool:
        self._look_at_life()
        matched = all(one.get_publisher_count() for one in self._subscriptions) and all(
            client.service_server_is_available() for client in self._clients
        )
        doubted = self._has_been_silent(matched) or self._dead
        return matched and not (doubted and self._only_mortals())

    def _has_been_silent(self, matched: bool) -> bool:
        """Whether there has been a server for a while, and no sign of life: then it may have died
        before it gave any. Only what was seen all the time counts.
        """
        now = current_time()
        if self._alive or not matched or now - self._looked > names.LEASE:
            self._silent_since = now
        self._looked = now
        return now - self._silent_since > FIRST_SIGN

    def servers(self) -> frozenset[bytes]:
        """Who serves, as ROS names the ends of the status topic: a server that is started anew is
        another one. It is looked up anew when others have come, or after a while, and not for each
        of many status lists: it takes some 0.1 ms.
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
        """There must be a server. For a while after the beginning it may still be discovered.

        Raises:
            ServerNotFound: There is none.
            ConnectionLost: ROS has been shut down.
        """
        while not self.is_there():
            self._check_ros()
            if current_time() >= self._deadline:
                raise ServerNotFound(
                    f"nobody serves the action {self._action!r} in ROS: there is no server of"
                    f" {self._names.send_goal.removesuffix('/_action/send_goal')}; start it, or"
                    f" wait for it with wait_for_server()"
                )
            await anyio.sleep(LOOK_PAUSE)
        self._deadline = -math.inf  # it is discovered, and missed at once if it leaves

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

    def _look_at_life(self) -> None:
        # It is looked at and not waited for, because the middleware wakes those who wait for it at
        # every status list as well, again and again.
        event = self._event.take_event()
        alive: int = self._alive if event is None else event.alive_count
        if alive != self._alive:
            self._alive, self._dead = alive, alive == 0

    def _only_mortals(self) -> bool:
        """Whether all servers that the graph still knows are of those who give signs of life: a
        lease tells them from others.
        """
        known = self._ros.node.get_publishers_info_by_topic(self._names.status)
        longest = int(2 * names.LEASE * 1e9)
        return all(one.qos_profile.liveliness_lease_duration.nanoseconds < longest for one in known)
