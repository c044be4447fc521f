"""Servers of the same action next to each other: each of them runs every goal.

ROS does not tell a client which of them has answered. But each server publishes the stamp of the
goal by its own clock, and the client was told the stamp in the acceptance. So the server whose
status list has that stamp, or the nearest one, has accepted the goal. Messages of topics have the
ID (GID) of their publisher, where the middleware and rclpy tell it: rclpy of Jazzy does not.
"""

from __future__ import annotations

import math

import anyio
from anyio import current_time

from fibaction.border.peer_text import clean_logger
from fibaction_transports.ros2.convert.status_bytes import stamps_of
from fibaction_transports.ros2.names import ActionNames
from fibaction_transports.ros2.node.ros_node import RosNode

RIVALS_PAUSE = 1.0
"""Seconds between two looks of a server for a second one of the same name."""
LEASES_BEFORE_WARNING = 2.0
"""Leases for which a client must have seen several servers before it warns."""
PARTICIPANT = slice(12)
"""The part of a GID that names the participant of DDS, which is one for each context of rclpy."""

logger = clean_logger("fibaction.ros2")


async def warn_of_rivals(ros: RosNode, action: str, status_topic: str) -> None:
    """Log a warning whenever a second server of the action appears, until ROS is shut down."""
    warned = False
    while ros.is_up:  # this look is also how a shutdown is noticed
        await anyio.sleep(RIVALS_PAUSE)
        rivals = ros.count_publishers(status_topic) > 1
        if rivals and not warned:
            text = f"{action}: another server serves it too, and ROS runs every goal twice"
            logger.warning("%s", text)
            ros.warn(text)
        warned = rivals


class Rivals:
    """Several servers of an action, as a client knows them."""

    def __init__(self, ros: RosNode, action: str, full: ActionNames, lease: float) -> None:
        self._ros = ros
        self._action = action
        self._names = full
        self._lease = lease
        self._since = math.inf
        """The time since which there are several servers."""
        self._warned = False
        self._has_publishers = True
        """False if the status lists have no ID of their publisher."""
        self._servers: frozenset[bytes] = frozenset()
        self._stamps: dict[bytes, dict[bytes, int]] = {}
        self._feedback: dict[bytes, frozenset[bytes]] = {}

    def note(self, servers: frozenset[bytes], count: int) -> None:
        """Note which servers there are, and warn when a second one has been there for a while.
        `count` leaves out those that are known to be silent, as one that was killed soon is.
        """
        if servers != self._servers:
            self._servers = servers
            self._stamps = {one: of for one, of in self._stamps.items() if one in servers}
            self._feedback.clear()
        if count < 2:
            self._since, self._warned = math.inf, False
            return
        self._since = min(self._since, current_time())
        if not self._warned and current_time() - self._since >= LEASES_BEFORE_WARNING * self._lease:
            self._warned = True
            feedback = (
                "is taken of one server" if self._has_publishers else "comes from all of them"
            )
            logger.warning(
                "%s: there are %d servers of this name, and each of them runs every goal; the first"
                " answer counts, and feedback %s: stop the others",
                self._action,
                count,
                feedback,
            )

    def note_list(self, server: bytes, message: bytes) -> None:
        """Note the stamps in a status list of one of several servers. `server` is empty if it is
        not known which of them has sent the list.
        """
        self._has_publishers = bool(server)
        if len(self._servers) > 1 and server in self._servers:
            self._stamps[server] = stamps_of(message)

    @property
    def can_be_told_apart(self) -> bool:
        """True if there are several servers, and messages tell which of them has sent them."""
        return len(self._servers) > 1 and self._has_publishers

    def feedback_of(self, goal_id: bytes, stamp: int) -> frozenset[bytes]:
        """Return the publishers of the feedback of the server that has accepted the goal with this
        stamp; none if that is not known yet, or if there is only one server.
        """
        distances = {
            server: abs(stamps[goal_id] - stamp)
            for server, stamps in self._stamps.items()
            if goal_id in stamps
        }
        if not distances or len(self._servers) < 2:
            return frozenset()
        best = min(distances, key=distances.__getitem__)
        if len(distances) == 1 and distances[best]:
            return frozenset()  # another server may soon list the goal, with a nearer stamp
        if not self._feedback.get(best):
            self._feedback[best] = self._publishers(best)
        return self._feedback[best]

    def _publishers(self, server: bytes) -> frozenset[bytes]:
        look = self._ros.publishers
        # The graph may tell the name of a node after its ends, which belong to no node until then.
        names = {one.node for one in look(self._names.status) if one.gid == server and one.node}
        found = [one.gid for one in look(self._names.feedback) if one.node in names]
        # Two nodes may have the same name, as two robots with the same program.
        same = [gid for gid in found if gid[PARTICIPANT] == server[PARTICIPANT]]
        return frozenset(same or found)
