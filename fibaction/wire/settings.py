"""The settings of both halves of a transport over the wire protocol.

Each setting has its default and its check here, and only here. `ServerSettings` and
`ClientSettings` are what the two halves read; `WireKeywords` is what a transport's constructor
takes, for type checkers and for the list in the error for a setting that does not exist.
`ConnectKeywords` and `ServeKeywords` are all settings that users pass on to transports.

A frame has one message. A server accepts frames of at most `Limits.frame`, 1 MiB by default, and as
the first one, before it knows the client, of 4 KiB (`FIRST_FRAME`). A client accepts frames of at
most `max_frame`, 16 MiB by default, or of `Limits.frame` if it is given limits. Each half tells the
other its limit when they say hello.

`fibaction` itself imports this module, so it imports nothing that costs time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import msgspec

from fibaction._runtime.plain_data import check_is_number
from fibaction.wire.auth import AccessPolicy, Authorize, check_token
from fibaction.wire.frames import LEAST_FRAME, MAX_FRAME

if TYPE_CHECKING:
    from ssl import SSLContext

    from fibaction.wire.tls_files import TlsFiles

HEARTBEAT = 1.0
"""Seconds between heartbeats, both ways, if nothing else is set."""


_SECONDS = ("handshake", "heartbeat", "write")
"""The limits that are times, and may be any number."""


class Limits(msgspec.Struct, frozen=True):
    """Limits of one server; a client that reaches one gets an error, and other clients do not.

    For example:

        serve(server, "tls://0.0.0.0:7400", cert="a.pem", limits=Limits(connections=100))
    """

    connections: int = 1000
    """Connections at the same time."""
    per_address: int | None = None
    """Connections of one address at the same time, of IPv6 those of one network of 64 bits; None
    for any number. Clients behind one proxy have one address."""
    goals: int = 10_000
    """Goals that one connection may follow at the same time."""
    follows: int = 100
    """Times that one connection may follow one goal at the same time."""
    lost: int = 10_000
    """Goals that are kept for clients whose connections are lost, over all of them; those that were
    lost first are given up sooner."""
    requests: int = 1000
    """Requests that one connection may wait for at the same time, in addition to its goals."""
    frame: int = 2**20
    """Bytes of the largest message of a client; at least 1024. A goal is decoded in one piece, and
    all other clients wait meanwhile: with a type of numbers about 15 ms for each MiB."""
    memory: int = 64 * 2**20
    """Bytes of goals that are being decided upon, for one connection."""
    total_memory: int = 256 * 2**20
    """Bytes of goals that are being decided upon, and of large messages that are being read or
    written, over all connections."""
    queue: int = 2**20
    """Bytes that wait to be written to one connection; answers wait while there are more."""
    handshake: float = 5.0
    """Seconds within which a client must say hello."""
    heartbeat: float = 15.0
    """Seconds between two messages of a client, at most; after four times that it counts as dead,
    even if it asks for more."""
    write: float = 30.0
    """Seconds within which a client must take a piece of an answer over HTTP, of 64 KiB at most."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: One of them is not a number, or one that counts things or bytes is not a
                whole one.
            ValueError: One of them is not positive or not finite, or `frame` is too small.
        """
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name == "per_address" and value is None:
                continue
            check_is_number(f"the limit of {name}", value)
            if not 0 < value < math.inf:
                raise ValueError(f"the limit of {name} is finite and more than 0, not {value}")
            if name not in _SECONDS and not isinstance(value, int):
                raise TypeError(f"the limit of {name} is a whole number, not {value!r}")
        if self.frame < LEAST_FRAME:
            raise ValueError(f"the limit of frame is at least {LEAST_FRAME}, not {self.frame}")


class ServerSettings(msgspec.Struct, frozen=True):
    """The settings of the serving half."""

    heartbeat: float = HEARTBEAT
    """Seconds between the heartbeats of the server."""
    access: AccessPolicy = msgspec.field(default_factory=AccessPolicy)
    """The tokens and permissions of the clients."""
    limits: Limits = msgspec.field(default_factory=Limits)
    orphans: Literal["keep", "cancel"] = "keep"
    """The fate of goals whose client does not come back: they keep running, or are canceled."""
    grace: float = 10.0
    """Seconds in which a client may come back for its goals."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or `orphans` is another word.
        """
        _check_range("heartbeat", self.heartbeat, 0.001, 3600)
        _check_range("grace", self.grace, 0, math.inf)
        if self.orphans not in ("keep", "cancel"):
            raise ValueError(f"orphans is 'keep' or 'cancel', not {self.orphans!r}")


class ClientSettings(msgspec.Struct, frozen=True):
    """The settings of the connecting half."""

    heartbeat: float = HEARTBEAT
    """Seconds between the heartbeats of the client."""
    token: str = ""
    """Access token sent to the server; empty if none."""
    reconnect: bool = True
    """Open a lost connection again, and continue with open calls."""
    reconnect_timeout: float = 30.0
    """Seconds that calls wait for a lost connection to come back."""
    window: int = 256
    """Feedback messages of a goal that wait here to be read; more wait at the server."""
    max_frame: int = MAX_FRAME
    """Bytes of the largest message that the client accepts."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or the token is too long or not valid text.
        """
        check_token(self.token)
        _check_range("heartbeat", self.heartbeat, 0.001, 3600)
        _check_range("window", self.window, 1, 2**31 - 1)
        _check_range("max_frame", self.max_frame, LEAST_FRAME, 2**32 - 1)
        _check_range("reconnect_timeout", self.reconnect_timeout, 0, math.inf)

    def __repr__(self) -> str:
        return "<ClientSettings>"  # a token has no place in a log


class _SharedKeywords(TypedDict, total=False):
    heartbeat: float
    limits: Limits | None


class ClientKeywords(_SharedKeywords, total=False):
    """The keyword arguments of a transport that a client uses."""

    token: str
    reconnect: bool
    reconnect_timeout: float
    window: int


class ServerKeywords(_SharedKeywords, total=False):
    """The keyword arguments of a transport that a server uses."""

    tokens: Mapping[str, str] | None
    authorize: Authorize | None
    orphans: Literal["keep", "cancel"]
    grace: float


class WireKeywords(ClientKeywords, ServerKeywords, total=False):
    """The keyword arguments that every transport over the wire protocol has."""


class _RosKeywords(TypedDict, total=False):
    namespace: str
    domain_id: int | None
    arguments: Sequence[str] | None
    node: Any
    feedback_depth: int
    discovery_timeout: float
    via: str
    search: Sequence[str]
    discovery: str
    peers: Sequence[str]
    network: Sequence[str]
    fragment_size: int


class _RosbridgeKeywords(TypedDict, total=False):
    accepted_after: float
    answer_timeout: float
    schemas: bool
    cancel_on_disconnect: bool


class _McpKeywords(TypedDict, total=False):
    allow: Iterable[str]
    unasked: Iterable[str]
    read_only: bool
    patience: float


class ConnectKeywords(ClientKeywords, _RosKeywords, _RosbridgeKeywords, total=False):
    """The settings that `connect` passes on to the transport of a URL."""

    tls: TlsFiles | SSLContext | None


class ServeKeywords(ServerKeywords, _RosKeywords, _McpKeywords, total=False):
    """The settings that `serve` passes on to the transports of URLs."""

    tls: TlsFiles | SSLContext | None
    insecure: bool
    hosts: Iterable[str]
    origins: Iterable[str]


def client_settings(given: WireKeywords) -> ClientSettings:
    """Return the settings of the connecting half.

    Raises:
        ValueError: A value is out of range.
    """
    limits = given.get("limits")
    fields = _fields_of(ClientSettings, given)
    if limits is not None:
        fields["max_frame"] = limits.frame
    return ClientSettings(**fields)


def server_settings(given: WireKeywords) -> ServerSettings:
    """Return the settings of the serving half.

    Raises:
        ValueError: A value is out of range.
    """
    access = AccessPolicy(given.get("tokens"), given.get("authorize"))
    fields = _fields_of(ServerSettings, given)
    fields["limits"] = given.get("limits") or Limits()
    return ServerSettings(access=access, **fields)


def _fields_of(kind: type[msgspec.Struct], given: WireKeywords) -> dict[str, Any]:
    return {name: value for name, value in given.items() if name in kind.__struct_fields__}


def _check_range(name: str, value: float, least: float, most: float) -> None:
    check_is_number(name, value)
    if not least <= value <= most:
        raise ValueError(f"{name} is between {least} and {most}, not {value}")
