"""The settings of both halves of a transport over the wire protocol.

Each setting has its default and its check here, and only here. `ClientSettings` are those of the
connecting half, and `WireSettings` those of both.

A frame has one message. A server accepts frames of at most `Limits.frame`, 1 MiB by default, and as
the first one, before it knows the client, of 4 KiB (`FIRST_FRAME`). A client accepts frames of at
most 16 MiB by default, or of `Limits.frame` if it is given limits. Each half tells the other its
limit when they say hello.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar, Literal

from fibaction._runtime.settings_struct import SettingsStruct
from fibaction.border.settings import TransportSettings, check_range
from fibaction.wire.auth import AccessPolicy, Authorize, check_token
from fibaction.wire.frames import LEAST_FRAME, MAX_FRAME
from fibaction.words.plain_data import check_is_number

HEARTBEAT = 1.0
"""Seconds between heartbeats, both ways, if nothing else is set."""


_SECONDS = ("handshake", "heartbeat", "write")
"""The limits that are times, and may be any number."""


class Limits(SettingsStruct, frozen=True):
    """Limits of one server; a client that reaches one gets an error, and other clients do not.

    For example:

        serve(server, "tls://0.0.0.0:7400", cert="a.pem", limits=Limits(connections=100))
    """

    connections: int = 1000
    """Connections at the same time."""
    per_address: int | None = None
    """Connections of one address at the same time; with IPv6, of one network of 64 bits. None is
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
            ValueError: One of them is not positive or not finite, or `frame` is out of range.
        """
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name == "per_address" and value is None:
                continue
            check_is_number(f"the limit of {name}", value)
            if not 0 < value < math.inf:
                raise ValueError(f"the limit of {name} must be finite and more than 0, not {value}")
            if name not in _SECONDS and not isinstance(value, int):
                raise TypeError(f"the limit of {name} must be a whole number, not {value!r}")
        check_range("the limit of frame", self.frame, LEAST_FRAME, 2**32 - 1)


DEFAULT_LIMITS = Limits()
"""The limits of a transport that is given none."""


def _check_are_limits(given: object) -> None:
    if not isinstance(given, Limits):
        raise TypeError(f"limits must be given as Limits(connections=100), not {given!r}")


class LineSettings(TransportSettings, frozen=True, kw_only=True):
    """The settings of a client over a line that is not opened again."""

    only_for_clients: ClassVar[tuple[str, ...]] = ("token", "window")

    token: str = ""
    """The access token that a client sends; empty if none."""
    heartbeat: float = HEARTBEAT
    """Seconds between heartbeats: more than 0, at most 3600, and at a client at most the
    limit of its server."""
    window: int = 256
    """The most feedback messages of a goal that wait at a client to be read; more wait at the
    server."""
    limits: Limits = DEFAULT_LIMITS
    """The `Limits` of a server; at a client, its `frame` is the size of the
    largest message that it accepts, in bytes, by default 16 MiB."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: `limits` are not `Limits`.
            ValueError: A number is out of range, or the token is too long or not valid text.
        """
        _check_are_limits(self.limits)
        check_token(self.token)
        check_range("heartbeat", self.heartbeat, 0.001, 3600)
        check_range("window", self.window, 1, 2**31 - 1)

    @property
    def max_frame(self) -> int:
        """Bytes of the largest message that a client accepts."""
        return MAX_FRAME if self.limits is DEFAULT_LIMITS else self.limits.frame


class ClientSettings(LineSettings, frozen=True, kw_only=True):
    """The settings of a client."""

    only_for_clients: ClassVar[tuple[str, ...]] = (
        *LineSettings.only_for_clients,
        "reconnect",
        "reconnect_timeout",
    )

    reconnect: bool = True
    """Open a lost connection again, and continue with open calls."""
    reconnect_timeout: float = 30.0
    """Seconds that the calls of a client wait for a lost connection to come back."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: As for `LineSettings`.
        """
        super().__post_init__()
        check_range("reconnect_timeout", self.reconnect_timeout, 0, math.inf)


class WireSettings(ClientSettings, frozen=True, kw_only=True):
    """The settings of both halves of a transport over the wire protocol; each reads its own."""

    only_for_servers: ClassVar[tuple[str, ...]] = ("tokens", "authorize", "orphans", "grace")

    tokens: Mapping[str, str] | None = None
    """The tokens that a server accepts, each with the name of its client;
    None lets every client in."""
    authorize: Authorize | None = None
    """The function that decides what a client may do at a server; None permits everything."""
    orphans: Literal["keep", "cancel"] = "keep"
    """The fate of the goals whose client does not come back to a server: `"keep"` continues them,
    `"cancel"` cancels them."""
    grace: float = 10.0
    """Seconds in which a client may come back to a server for its goals."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: As for `ClientSettings`, or `orphans` is another word.
        """
        super().__post_init__()
        check_range("grace", self.grace, 0, math.inf)
        if self.orphans not in ("keep", "cancel"):
            raise ValueError(f"orphans must be 'keep' or 'cancel', not {self.orphans!r}")
        _ = self.access  # which checks the tokens

    @cached_property
    def access(self) -> AccessPolicy:
        """The tokens and permissions of the clients."""
        return AccessPolicy(self.tokens, self.authorize)
