"""Frames in a stream of bytes: each is its length in four bytes, big-endian, and its content.

Sans-I/O: bytes in, frames out. The content of a frame is not examined.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from struct import Struct
from typing import Protocol

from fibaction.border.byte_budgets import ByteBudget
from fibaction.words.errors import LimitReached, ProtocolError

HEADER = 4
"""Length of the header of a frame, in bytes."""
MAX_FRAME = 16 * 2**20
"""Default limit of the frames that a client accepts, in bytes: larger than any sensible message,
smaller than memory. The limit of a server is `Limits.frame`, 1 MiB by default."""

FIRST_FRAME = 4096
"""Limit of the first frame of a client, in bytes: a server that does not know the client yet holds
no more for it."""
LEAST_FRAME = 1024
"""Least limit of a frame, in bytes: every answer that cannot be left out fits into it."""
UNCOUNTED = 2**16
"""Bytes of an incomplete frame that are not counted: small messages always pass."""

BUSY = "the server is busy: it has no room for a large message, so try again later"
"""The sentence for a peer whose large message is not waited for any longer."""

_LENGTH = Struct(">I")
_pack, _unpack = _LENGTH.pack, _LENGTH.unpack_from


_TLS = "TLS: use tls:// at both ends, or at neither"
_HTTP = "HTTP: use http:// at both ends, or check the port"
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


class Framing(ABC):
    """The form that frames have in a stream of bytes, both ways.

    Sans-I/O. A form may have bytes of its own beside the frames, such as WebSocket's handshake and
    pongs: it keeps them as its answer until the line can send them.
    """

    has_answer: bool = False
    """True if there are bytes to send that belong to no frame; `encode` returns them first."""
    has_ended: bool = False
    """True if the peer has closed: `check` raises it."""
    is_closed: bool = True
    """True if nothing more is expected of the peer when the line is closed."""

    ends_stream: bool = False
    """True if the stream to the peer ends with the goodbye: it is to read that, and leave."""

    @abstractmethod
    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes, and return the frames that are now complete.

        Raises:
            ActionError: The bytes are invalid, or the peer has closed.
        """

    @abstractmethod
    def encode(self, frames: Sequence[bytes]) -> bytes:
        """Return the answer, if there is one, and the frames as bytes to send."""

    @property
    @abstractmethod
    def is_within_frame(self) -> bool:
        """True if part of a frame has arrived, and the rest has not."""

    def check(self) -> None:  # noqa: B027  # a form may have no end of its own
        """Raise the end of the peer, if it has ended behind frames that `feed` has returned.

        Raises:
            ConnectionLost: The peer has closed.
        """

    def goodbye(self) -> bytes:
        """Return the last bytes to send; what arrives from now on goes to `discard`."""
        return b""

    def discard(self, data: bytes) -> None:  # noqa: B027  # as above
        """Look for the end of the peer in the bytes, and ignore everything else."""

    def close(self) -> None:  # noqa: B027  # as above
        """Forget what is incomplete: no more bytes come."""


class FrameReader(Framing):
    """Frames one after another, each after its length.

    Frames may arrive in pieces of any size.

    It keeps at most one incomplete frame. The bytes of a large one are counted in a memory that
    many readers share, until the frame is complete or the reader is closed.
    """

    def __init__(
        self, limit: int = MAX_FRAME, *, first: int | None = None, memory: FrameMemory | None = None
    ) -> None:
        """Accept frames of at most `limit` bytes; the first one of at most `first`, if given."""
        self._limit = limit
        self._next_limit = limit if first is None else first
        self._memory = memory
        self._is_counted = self._is_given_up = False
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Add received bytes, and return the frames that are now complete.

        Raises:
            LimitReached: The readers that share the memory hold too much, and this one the most.
            ProtocolError: A frame is longer than the limit. The stream cannot be read any further.
        """
        if self._is_given_up:
            raise LimitReached(BUSY)
        buffer = self._buffer
        if not buffer:  # usually all bytes are consumed, and none are copied
            frames, start = self._split(data, data)
            buffer += data[start:]
        else:
            buffer += data
            with memoryview(buffer) as view:
                frames, start = self._split(buffer, view)
            del buffer[:start]
        if self._is_counted or len(buffer) > UNCOUNTED:
            self._count(max(0, len(buffer) - UNCOUNTED))
            if self._is_given_up:
                raise LimitReached(BUSY)
        return frames

    def encode(self, frames: Sequence[bytes]) -> bytes:
        return framed(frames)

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
        self._is_counted = held > 0
        if self._memory is not None:
            self._memory.hold(self, held)

    def close(self) -> None:
        """Forget the incomplete frame: no more bytes come."""
        self._buffer = bytearray()
        self._count(0)

    def give_up(self) -> None:
        """Forget the incomplete frame, and fail as soon as more bytes come."""
        self._is_given_up = True
        self.close()

    @property
    def is_within_frame(self) -> bool:
        """True if part of a frame has arrived, and the rest has not."""
        return bool(self._buffer)


class Holder(Protocol):
    """A part that holds a large frame."""

    def give_up(self) -> None:
        """Let go of the frame, at the cost of the connection."""


class FrameMemory:
    """The memory of the large frames of all connections of a server, read or written.

    When there is too little, the part that holds the most is given up: so a peer that begins many
    large messages and completes none, or that takes none, does not keep out those of others.
    """

    def __init__(self, budget: ByteBudget) -> None:
        """Share a budget, even with other things."""
        self._budget = budget
        self._held: dict[Holder, int] = {}

    def hold(self, holder: Holder, size: int) -> None:
        """Note that a part holds so many bytes now; give up parts if all hold too much."""
        more = size - self._held.pop(holder, 0)
        if size:
            self._held[holder] = size
        self._budget.take(more)
        while more > 0 and self._held and not self._budget.has_room():
            max(self._held, key=self._held.__getitem__).give_up()


def _looks_like(first: bytes) -> str:
    for start, name in _OTHERS.items():
        if first.startswith(start):
            return f": this looks like {name}"
    return ""
