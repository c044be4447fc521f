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


def header(length: int) -> bytes:
    """What comes before a frame of that length."""
    return _LENGTH.pack(length)


def framed(frames: Iterable[bytes]) -> bytes:
    """The frames as they are sent, one behind the other."""
    parts: list[bytes] = []
    for frame in frames:
        parts += (_LENGTH.pack(len(frame)), frame)
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
        buffer = self._buffer
        pending: bytes | bytearray = data
        if buffer:
            buffer += data
            pending = buffer
        frames: list[bytes] = []
        start, end = 0, len(pending)
        while end - start >= HEADER:
            length: int = _LENGTH.unpack_from(pending, start)[0]
            if length > self._limit:
                raise ProtocolError(
                    f"a frame of {length} bytes was announced, and {self._limit} are the limit"
                )
            if end - start < HEADER + length:
                break
            start += HEADER
            frames.append(bytes(pending[start : start + length]))
            start += length
        if pending is buffer:
            del buffer[:start]
        else:  # most often all of it is used, and never copied
            buffer += pending[start:]
        return frames

    @property
    def is_within_frame(self) -> bool:
        """Whether part of a frame has arrived, and the rest has not."""
        return bool(self._buffer)
