"""Frames in a stream of bytes: each is its length in four bytes, big-endian, and its content.

Sans-I/O: bytes in, frames out. The content of a frame is not examined.
"""

from __future__ import annotations

from collections.abc import Iterable
from struct import Struct

from fibaction.exceptions import ProtocolError

HEADER = 4
"""Length of the header of a frame, in bytes."""
MAX_FRAME = 16 * 2**20
"""Default limit of a frame, in bytes: larger than any sensible message, smaller than memory."""

_LENGTH = Struct(">I")
_pack, _unpack = _LENGTH.pack, _LENGTH.unpack_from


_TLS = "TLS: use tls:// at both ends, or at neither"
_HTTP = "HTTP: check the port"
_OTHERS = {
    b"\x16\x03": _TLS,  # a client says hello
    b"\x15\x03": _TLS,  # a server does not understand its client
    b"HTTP": _HTTP,  # a server answers
    b"<!DO": _HTTP,  # a server answers as in HTTP 0.9
    b"<htm": _HTTP,
    b"GET ": _HTTP,
    b"HEAD": _HTTP,
    b"POST": _HTTP,
    b"PUT ": _HTTP,
    b"OPTI": _HTTP,
    b"CONN": _HTTP,
}
"""First bytes of other protocols, to give a helpful error."""


def header(length: int) -> bytes:
    """Return the header of a frame of that length."""
    return _pack(length)


def framed(frames: Iterable[bytes]) -> bytes:
    """Return the frames as they are sent: one after another, each after its header."""
    parts: list[bytes] = []
    for frame in frames:
        parts += (_pack(len(frame)), frame)
    return b"".join(parts)


class FrameReader:
    """Parser of frames, which may arrive in pieces of any size."""

    def __init__(self, limit: int = MAX_FRAME) -> None:
        """Accept frames of at most `limit` bytes."""
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes, and return the frames that are now complete.

        At most one incomplete frame is kept.

        Raises:
            ProtocolError: A frame is longer than the limit. The stream cannot be read any further.
        """
        buffer, limit = self._buffer, self._limit
        pending: bytes | bytearray = data
        if buffer:
            buffer += data
            pending = buffer
        frames: list[bytes] = []
        start, end = 0, len(pending)
        while (body := start + HEADER) <= end:
            length: int = _unpack(pending, start)[0]
            if length > limit:
                raise ProtocolError(
                    f"frame of {length} bytes exceeds the limit of {limit} bytes"
                    f"{_looks_like(_pack(length))}"
                )
            if body + length > end:
                break
            start = body + length
            frames.append(bytes(pending[body:start]))
        if pending is buffer:
            del buffer[:start]
        else:  # usually all bytes are consumed, and none are copied
            buffer += pending[start:]
        return frames

    @property
    def is_within_frame(self) -> bool:
        """True if part of a frame has arrived, and the rest has not."""
        return bool(self._buffer)


def _looks_like(first: bytes) -> str:
    for start, name in _OTHERS.items():
        if first.startswith(start):
            return f": this looks like {name}"
    return ""
