"""The one error of a packet that cannot be read."""

from __future__ import annotations

from fibaction.words.errors import ProtocolError


class InvalidPacket(ProtocolError):
    """A datagram, or a list of parameters in it, that breaks the rules or the limits of RTPS."""
