"""The names of topics, services and nodes in Zenoh, as `rmw_zenoh_cpp` makes them.

A topic, and a service, has one key; the hash of the type is a part of it. So ends with other
versions of a type do not hear each other, and no error says so.

A node, and each of its ends, has a liveliness token, which is there as long as its session. The
graph of ROS is made of them: https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md
"""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Iterator
from functools import cached_property
from typing import Final, NamedTuple

from msgspec import Struct
from xxhash import xxh3_128_digest

from fibaction_transports.ros2.node.parts import NO_HASH
from fibaction_transports.ros2.node.rivals import PARTICIPANT
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.message_type import (
    MessageType,
    ServiceType,
    dds_type,
    ros_type,
)

NODE: Final = "NN"
PUBLISHER: Final = "MP"
SUBSCRIPTION: Final = "MS"
SERVER: Final = "SS"
CLIENT: Final = "SC"
KINDS: Final = (PUBLISHER, SUBSCRIPTION, SERVER, CLIENT)

_SPACE = "@ros2_lv"
_DEFAULT_DEPTH = 42
_NODE_PARTS, _END_PARTS = 9, 13
_RELIABILITIES = {"1": "reliable", "2": "best_effort"}
_DURABILITIES = {"1": "transient_local", "2": "volatile"}
_NUMBER = re.compile(r"[0-9]{0,19}")
_BILLION = 10**9
_INFINITE = 2**63 - 1
"""The nanoseconds of an infinite duration."""
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_SIZE = 16
MOST_CHARACTERS: Final = 4_096
"""Characters of a token; a longer one is ignored."""


def key_of(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """Return the key of a topic or a service, which is given by its full name."""
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{type_hash}"


ANY_HASH: Final = "*"
"""In a key: any version of a type. In a token there is `NO_HASH` instead."""


def hash_of(of: MessageType | ServiceType) -> str:
    """Return the hash of a type for a key; `ANY_HASH` if the type is known in part only."""
    return of.type_hash if of.is_known else ANY_HASH


def all_tokens(domain: int) -> str:
    """Return the expression of the tokens of a domain."""
    return f"{_SPACE}/{domain}/**"


def wire_gid(token: str) -> bytes:
    """Return the ID (GID) of an end in messages."""
    return xxh3_128_digest(token.encode())[::-1]


class Entity(Struct, frozen=True, kw_only=True, dict=True):
    """A node, or one of its ends, as its token tells of it."""

    token: str
    domain: str
    session: str
    """The ID of its session."""
    node_number: str
    kind: str
    node: str
    """The full name of the node."""
    topic: str = ""
    """The full name of the topic or the service; empty for a node."""
    type_name: str = ""
    """The name of the type in ROS."""
    type_hash: str = ""
    qos: EndQos = EndQos()

    @property
    def key(self) -> str:
        """The key of the topic or the service."""
        return key_of(int(self.domain), self.topic, self.type_name, self.type_hash)

    @cached_property
    def wire_gid(self) -> bytes:
        """The ID (GID) of the end in messages."""
        return wire_gid(self.token)

    @cached_property
    def gid(self) -> bytes:
        """The ID of the end in the graph, of which a part is the same for all ends of a node."""
        node = xxh3_128_digest(f"{self.session}/{self.node_number}".encode())[PARTICIPANT]
        return node + self.wire_gid[: _GID_SIZE - len(node)]


class NodeTokens:
    """Makes the tokens of one node."""

    def __init__(
        self, domain: int, session: str, numbers: Iterator[int], namespace: str, name: str
    ) -> None:
        """`numbers` are those of the session that are still free."""
        self._number = next(numbers)
        self._numbers = numbers
        self._head = f"{_SPACE}/{domain}/{session}/{self._number}"
        self._tail = f"%/{_escaped(namespace)}/{name}"

    def node(self) -> str:
        """Return the token of the node itself."""
        return f"{self._head}/{self._number}/{NODE}/{self._tail}"

    def end(self, kind: str, topic: str, type_name: str, type_hash: str, qos: EndQos) -> str:
        """Return a new token for an end."""
        told = NO_HASH if type_hash == ANY_HASH else type_hash
        words = f"{_escaped(topic)}/{dds_type(type_name)}/{told}/{_qos_text(qos)}"
        return f"{self._head}/{next(self._numbers)}/{kind}/{self._tail}/{words}"


def read_token(token: str) -> Entity | None:
    """Read a token; None if it is not one of a node or an end of ROS."""
    parts = token.split("/")
    if len(parts) < _NODE_PARTS or len(token) > MOST_CHARACTERS or parts[0] != _SPACE:
        return None
    _, domain, session, node_number, _, kind, _, namespace, name = parts[:_NODE_PARTS]
    if not (domain.isascii() and domain.isdecimal() and len(domain) < 10):
        return None
    node = f"{_plain(namespace).rstrip('/')}/{name}"
    if kind == NODE:
        return Entity(
            token=token,
            domain=domain,
            session=session,
            node_number=node_number,
            kind=kind,
            node=node,
        )
    if kind not in KINDS or len(parts) < _END_PARTS:
        return None
    topic, type_name, type_hash, words = parts[_NODE_PARTS:_END_PARTS]
    qos = _read_qos(words)
    if qos is None:
        return None
    return Entity(
        token=token,
        domain=domain,
        session=session,
        node_number=node_number,
        kind=kind,
        node=node,
        topic=_plain(topic),
        type_name=ros_type(type_name),
        type_hash=type_hash,
        qos=qos,
    )


def _escaped(name: str) -> str:
    return name.replace("/", "%")


def _plain(name: str) -> str:
    return name.replace("%", "/")


def _qos_text(qos: EndQos) -> str:
    """Return a quality of service; what is the default of ROS is left empty."""
    reliability = "" if qos.reliability == "reliable" else "2"
    durability = "" if qos.durability == "volatile" else "1"
    history = "" if qos.history == "keep_last" else "2"
    times = f"{_duration_text(qos.deadline)}:{_duration_text(qos.lifespan)}"
    kind = "" if qos.liveliness == "automatic" else "3"
    liveliness = f"{kind},{_duration_text(qos.lease)}"
    return f"{reliability}:{durability}:{history},{qos.depth}:{times}:{liveliness}"


def _duration_text(seconds: float) -> str:
    if math.isinf(seconds):
        return ","
    return ",".join(map(str, divmod(round(seconds * _BILLION), _BILLION)))


def _read_qos(words: str) -> EndQos | None:
    reliability, *rest = words.split(":")
    if len(rest) < 2:
        return None
    durability, history, deadline, lifespan, liveliness = [*rest, "", "", ""][:5]
    kind, _, lease = liveliness.partition(",")
    history, _, depth = history.partition(",")
    depth = depth or str(_DEFAULT_DEPTH)
    if not (depth.isascii() and depth.isdecimal() and len(depth) < 20):
        return None
    return EndQos(
        reliability=_RELIABILITIES.get(reliability, "reliable"),
        durability=_DURABILITIES.get(durability, "volatile"),
        history="keep_all" if history == "2" else "keep_last",
        depth=int(depth),
        deadline=_read_duration(deadline),
        liveliness="manual_by_topic" if kind == "3" else "automatic",
        lease=_read_duration(lease),
        lifespan=_read_duration(lifespan),
    )


def _read_duration(words: str) -> float:
    """Return a duration in seconds; infinity if it is the default, or is none."""
    seconds, _, nanoseconds = words.partition(",")
    if not all(_NUMBER.fullmatch(one) for one in (seconds, nanoseconds)):
        return math.inf
    found = int(seconds or 0) * _BILLION + int(nanoseconds or 0)
    return found / _BILLION if 0 < found < _INFINITE else math.inf


class OwnEnd(NamedTuple):
    """An end of this node."""

    name: str
    """The full name of its topic or service."""
    key: str
    token: str
    type_hash: str
    """The hash of its type, as in the key."""

    @property
    def gid(self) -> bytes:
        """The ID of the end in messages."""
        return wire_gid(self.token)


class Attachment(NamedTuple):
    """The words that go with each message, request and answer."""

    number: int
    """The number of the message; of a request, also of the answer to it."""
    gid: bytes
    """The ID of the publisher, or of the client."""


def attachment(number: int, gid: bytes) -> bytes:
    """Return the attachment of a message that is sent now."""
    return _ATTACHMENT.pack(number, time.time_ns(), _GID_SIZE, gid)


def read_attachment(data: bytes) -> Attachment | None:
    """Read an attachment; None if it is not one of ROS."""
    if len(data) != _ATTACHMENT.size:
        return None
    number, _, size, gid = _ATTACHMENT.unpack(data)
    return Attachment(number, gid) if size == _GID_SIZE else None
