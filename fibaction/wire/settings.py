"""What a server lets one client use."""

from __future__ import annotations

import math

import msgspec

from fibaction.wire.framing import MAX_FRAME


class Limits(msgspec.Struct, frozen=True):
    """What one server grants; over a limit, that client gets an error, and nobody else notices."""

    connections: int = 1000
    """At the same time."""
    goals: int = 10_000
    """That one connection may follow at the same time."""
    requests: int = 1000
    """That one connection may wait for at the same time, beside its goals."""
    frame: int = MAX_FRAME
    """Bytes of the largest message."""
    memory: int = 64 * 2**20
    """Bytes of goals that are being decided upon, for one connection."""
    queue: int = 2**20
    """Bytes that wait to be written to one connection before whoever has more to say waits."""
    handshake: float = 5.0
    """Seconds until a client must have said who it is."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: One of them is not positive, or not finite.
        """
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"the limit of {name} is finite and more than 0, not {value}")
