"""The graph of ROS as liveliness tokens tell of it: each node, and each of its ends, has one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction_transports.ros2.node.parts import NO_HASH, DiscoveryState, EndInfo
from fibaction_transports.ros2.node.ros_node import RosGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    ANY_HASH,
    CLIENT,
    NODE,
    PUBLISHER,
    SERVER,
    SUBSCRIPTION,
    Entity,
    read_token,
)

MOST_TOKENS: Final = 20_000
"""Tokens that are kept; more are ignored."""
QUIET: Final = 0.1
"""Seconds without news after which no token is expected that was there before."""

logger = clean_logger("fibaction.ros2")


class ZenohGraph(RosGraph):
    """The nodes of a domain and their ends, those of this node among them."""

    def __init__(self, has_hashes: bool = True) -> None:
        self._unknown = "" if has_hashes else NO_HASH
        """The hash that tells nothing of a type."""
        self._entities: dict[str, Entity] = {}
        self._ends: dict[tuple[str, str], dict[str, Entity]] = {}
        """The ends of each kind and name."""
        self._publishers: dict[bytes, bytes] = {}
        """The IDs of publishers in the graph, by those in their messages."""
        self.news = Notifier()
        """Notifies when tokens come or go."""
        self._changes = 0
        self._is_complete = False
        self._is_full = False

    def add(self, token: str) -> None:
        """Add a token."""
        if token in self._entities or (entity := read_token(token)) is None:
            return
        if len(self._entities) >= MOST_TOKENS:
            if not self._is_full:
                self._is_full = True
                logger.warning("more than %d tokens of ROS: the others are ignored", MOST_TOKENS)
            return
        self._note_change()
        self._entities[token] = entity
        self._ends.setdefault((entity.kind, entity.topic), {})[token] = entity
        if entity.kind == PUBLISHER:
            self._publishers[entity.wire_gid] = entity.gid

    def remove(self, token: str) -> Entity | None:
        """Remove a token, and return what it told of; None if it is not known."""
        entity = self._entities.pop(token, None)
        if entity is None:
            return None
        self._note_change()
        self._is_full = False
        place = entity.kind, entity.topic
        del self._ends[place][token]
        if not self._ends[place]:
            del self._ends[place]
        self._publishers.pop(entity.wire_gid, None)
        return entity

    def _note_change(self) -> None:
        self._changes += 1
        self.news.notify()

    def note_complete(self) -> None:
        """Note that all tokens have come that were there at the beginning."""
        self._is_complete = True

    def publisher(self, wire_gid: bytes) -> bytes:
        """Return the ID of the publisher of a message; empty if it is not known."""
        return self._publishers.get(wire_gid, b"")

    def ends(self, kind: str, topic: str) -> list[Entity]:
        """Return the ends of a kind."""
        return list(self._ends.get((kind, topic), {}).values())

    # Questions

    def discovery(self) -> DiscoveryState:
        return DiscoveryState(self._changes, not self._is_complete, QUIET)

    def nodes(self) -> set[str]:
        return {one.node for one in self._ends.get((NODE, ""), {}).values()}

    def topics(self) -> list[tuple[str, str]]:
        return self._types_of(PUBLISHER, SUBSCRIPTION)

    def services(self) -> list[tuple[str, str]]:
        return self._types_of(SERVER)

    def _types_of(self, *wanted: str) -> list[tuple[str, str]]:
        found = {
            topic: next(iter(ends.values())).type_name
            for (kind, topic), ends in self._ends.items()
            if kind in wanted
        }
        return list(found.items())

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return self._infos(PUBLISHER, topic)

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return self._infos(SUBSCRIPTION, topic)

    def request_readers(self, service: str) -> Sequence[EndInfo]:
        return self._infos(SERVER, service)

    def answer_writers(self, service: str) -> Sequence[EndInfo]:
        return self._infos(SERVER, service)

    def count_callers(self, service: str) -> int:
        return len(self._ends.get((CLIENT, service), ()))

    def count_publishers(self, topic: str) -> int:
        return len(self._ends.get((PUBLISHER, topic), ()))

    def count_subscriptions(self, topic: str) -> int:
        return len(self._ends.get((SUBSCRIPTION, topic), ()))

    def count_connected(self, kind: str, topic: str, type_hash: str) -> int:
        """Return the number of ends that have this version of the type."""
        ends = self._ends.get((kind, topic), {}).values()
        return sum(type_hash in (one.type_hash, ANY_HASH) for one in ends)

    def _infos(self, kind: str, topic: str) -> list[EndInfo]:
        return [
            EndInfo(
                one.gid,
                one.node,
                one.qos,
                one.type_hash.removeprefix(self._unknown),
                type_name=one.type_name,
            )
            for one in self.ends(kind, topic)
        ]
