"""Frames in a stream of bytes: each is its length in four bytes, big-endian, and its content.

Sans-I/O: bytes in, frames out. The content of a frame is not examined.
"""

from __future__ import annotations

from collections.abc import Iterable
from struct import Struct

from fibaction._budget import ByteBudget
from fibaction.exceptions import LimitReached, ProtocolError

HEADER = 4
"""Length of the header of a frame, in bytes."""
MAX_FRAME = 16 * 2**20
"""Default limit of a frame, in bytes: larger than any sensible message, smaller than memory."""

FIRST_FRAME = 4096
"""Limit of the first frame of a client, in bytes: a server that does not know the client yet holds
no more for it."""
LEAST_FRAME = 1024
"""Least limit of a frame, in bytes: every answer that cannot be left out fits into it."""
UNCOUNTED = 2**16
"""Bytes of an incomplete frame that are not counted: small messages always pass."""

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
    """Parser of frames, which may arrive in pieces of any size.

    It keeps at most one incomplete frame. What a large one takes is counted in a budget that many
    readers share, until the frame is complete or the reader is closed.
    """

    def __init__(
        self, limit: int = MAX_FRAME, *, first: int | None = None, budget: ByteBudget | None = None
    ) -> None:
        """Accept frames of at most `limit` bytes; the first one of at most `first`, if given."""
        self._limit = limit
        self._next_limit = limit if first is None else first
        self._budget = budget
        self._counted = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes, and return the frames that are now complete.

        Raises:
            LimitReached: The readers that share the budget hold too much.
            ProtocolError: A frame is longer than the limit. The stream cannot be read any further.
        """
        buffer = self._buffer
        if not buffer:  # usually all bytes are consumed, and none are copied
            frames, start = self._split(data, data)
            buffer += data[start:]
        else:
            buffer += data
            with memoryview(buffer) as view:
                frames, start = self._split(buffer, view)
            del buffer[:start]
        if self._counted or len(buffer) > UNCOUNTED:
            self._count(max(0, len(buffer) - UNCOUNTED))
        return frames

    def _split(self, data: bytes | bytearray, view: bytes | memoryview) -> tuple[list[bytes], int]:
        """Return the complete frames in the bytes, and the place behind the last of them."""
        limit, frames = self._next_limit, list[bytes]()
        start, end = 0, len(data)
        while (body := start + HEADER) <= end:
            length: int = _unpack(data, start)[0]
            if length > limit:
                raise ProtocolError(
                    f"frame of {length} bytes exceeds the limit of {limit} bytes"
                    f"{_looks_like(_pack(length))}"
                )
            if body + length > end:
                break
            start = body + length
            frames.append(bytes(view[body:start]))
            limit = self._limit
        self._next_limit = limit
        return frames, start

    def _count(self, held: int) -> None:
        """Count the bytes that are held now, above those that are not counted."""
        if self._budget is not None:
            more, self._counted = held - self._counted, held
            self._budget.take(more)
            if more > 0 and not self._budget.has_room():
                raise LimitReached(
                    f"the server is busy: it holds {self._budget.limit} bytes of unfinished"
                    f" messages and of goals that are being decided upon, so try again later"
                )

    def close(self) -> None:
        """Forget the incomplete frame: no more bytes come."""
        self._buffer = bytearray()
        self._count(0)

    @property
    def is_within_frame(self) -> bool:
        """True if part of a frame has arrived, and the rest has not."""
        return bool(self._buffer)


def _looks_like(first: bytes) -> str:
    for start, name in _OTHERS.items():
        if first.startswith(start):
            return f": this looks like {name}"
    return ""
