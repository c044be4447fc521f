"""Frames in a stream of bytes: the length in four bytes, big-endian, and then so many bytes.

Sans-I/O: bytes in, frames out. What is in a frame is not looked at.
"""

from __future__ import annotations

from collections.abc import Iterable
from struct import Struct

from fibaction.exceptions import ProtocolError

HEADER = 4
MAX_FRAME = 16 * 2**20
"""Larger than any sensible message, smaller than memory."""

_LENGTH = Struct(">I")
_pack, _unpack = _LENGTH.pack, _LENGTH.unpack_from


_OTHERS = {b"\x16\x03": "TLS", b"GET ": "HTTP", b"POST": "HTTP", b"HEAD": "HTTP"}
"""How those begin who take this for something else."""


def header(length: int) -> bytes:
    """What comes before a frame of that length."""
    return _pack(length)


def framed(frames: Iterable[bytes]) -> bytes:
    """The frames as they are sent, one behind the other."""
    parts: list[bytes] = []
    for frame in frames:
        parts += (_pack(len(frame)), frame)
    return b"".join(parts)


class FrameReader:
    """Cuts frames out of bytes that arrive in pieces of any size."""

    def __init__(self, limit: int = MAX_FRAME) -> None:
        """`limit` is the length of the largest frame that is let through."""
        self._limit = limit
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Take more bytes, and give the frames that are complete by now.

        It never holds more than one frame that is not complete.

        Raises:
            ProtocolError: A frame is longer than the limit. The stream is of no use any more.
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
                    f"a frame of {length} bytes was announced, and {limit} are the limit"
                    f"{_looks_like(_pack(length))}"
                )
            if body + length > end:
                break
            start = body + length
            frames.append(bytes(pending[body:start]))
        if pending is buffer:
            del buffer[:start]
        else:  # most often all of it is used, and never copied
            buffer += pending[start:]
        return frames

    @property
    def is_within_frame(self) -> bool:
        """Whether part of a frame has arrived, and the rest has not."""
        return bool(self._buffer)


def _looks_like(first: bytes) -> str:
    for start, name in _OTHERS.items():
        if first.startswith(start):
            return f": it looks like {name}"
    return ""
