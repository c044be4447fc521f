"""Samples of a topic: as received, and their payload with its padding."""

from __future__ import annotations

from msgspec import Struct

from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.messages.layout import ENCAPSULATION
from fibaction_transports.rtps.messages.parameters import STATUS_INFO, Parameters
from fibaction_transports.rtps.messages.submessages import Data

PADDING_BITS = 0x03
"""The bits of the encapsulation header that count the padding."""
_ENDED_BITS = 0x03
DISPOSED = b"\x00\x00\x00\x03"
"""The status of a sample that says: disposed and unregistered."""


class Sample(Struct, frozen=True):
    """One sample that a reader has received."""

    writer: Guid
    number: int
    payload: bytes
    """The serialized data with its encapsulation header, without padding; or empty."""
    inline_qos: Parameters | None = None
    time: float | None = None
    """The time of the writer, in seconds since 1970; None if it has not told it."""
    is_key: bool = False
    """True if the payload is a key only."""

    @property
    def is_ended(self) -> bool:
        """True if the sample says that what it is about is disposed or unregistered."""
        if self.inline_qos is not None:
            for pid, status in self.inline_qos.items:
                if pid == STATUS_INFO and int.from_bytes(status[3:4]) & _ENDED_BITS:
                    return True
        return False


def received_sample(writer: Guid, data: Data, time: float | None) -> Sample:
    """Return the sample in a submessage, as its own bytes."""
    content = b"" if data.payload is None else unpadded(data.payload)
    return Sample(writer, data.number, content, data.inline_qos, time, data.is_key)


def padded(payload: bytes) -> bytes:
    """Return a payload that is padded to a multiple of four bytes, as its header then tells.

    Raises:
        ValueError: The payload has no encapsulation header.
    """
    if len(payload) < ENCAPSULATION:
        raise ValueError(f"payload of {len(payload)} bytes has no encapsulation header of 4 bytes")
    padding = -len(payload) % 4
    return b"".join(
        (payload[:3], bytes([payload[3] & ~PADDING_BITS | padding]), payload[4:], bytes(padding))
    )


def unpadded(payload: bytes | memoryview) -> bytes:
    """Return a received payload without its padding, and with none in its header."""
    padding = payload[3] & PADDING_BITS
    if not padding or len(payload) < ENCAPSULATION + padding:
        return bytes(payload)
    view = memoryview(payload)
    end = len(payload) - padding
    return b"".join((view[:3], bytes([payload[3] & ~PADDING_BITS]), view[4:end]))
