"""`Channel`: a connection that moves frames, and all that a transport of bytes has to supply.

A transport over a stream of bytes wraps it in a `StreamChannel`; one that has frames of its own,
such as WebSocket, implements `Channel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import anyio
from anyio.abc import ByteStream

from fibaction.exceptions import ConnectionLost
from fibaction.framing import FrameReader, header

CHUNK = 2**16
"""Bytes read or written at once: large enough that the cost of a call does not count, and small
enough that a slow line moves one within any sensible limit."""


class Channel(ABC):
    """Moves frames, in order and whole."""

    peer: str
    """Who is at the other end, for a person to read: `127.0.0.1:51234`."""

    progress: int = 0
    """Grows with each piece of a message that the other end has taken: so a large message on a slow
    line can be told from a peer that does not read."""

    @abstractmethod
    async def send(self, frames: Sequence[bytes]) -> None:
        """Send frames, as few writes as possible.

        Raises:
            ConnectionLost: The connection has ended.
        """

    @abstractmethod
    async def receive(self) -> list[bytes]:
        """Wait until something arrives, and give the frames that are whole by then, if any.

        Raises:
            ConnectionLost: The connection has ended.
            ProtocolError: What came is no frame.
        """

    @abstractmethod
    async def aclose(self) -> None:
        """Close the connection, at once if it cannot be done in good order."""


class StreamChannel(Channel):
    """Frames over a stream of bytes."""

    def __init__(self, stream: ByteStream, peer: str, max_frame: int) -> None:
        self.peer = peer
        self._stream = stream
        self._reader = FrameReader(max_frame)
        self._unfinished = False

    async def send(self, frames: Sequence[bytes]) -> None:
        parts: list[bytes] = []
        for frame in frames:
            parts += (header(len(frame)), frame)
        data = b"".join(parts)
        if self._unfinished:
            raise ConnectionLost(f"the last message to {self.peer} was cut off")
        self._unfinished = True
        try:
            for start in range(0, len(data), CHUNK):
                await self._stream.send(data[start : start + CHUNK])
                self.progress += 1
        except (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError) as exc:
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc
        self._unfinished = False

    async def receive(self) -> list[bytes]:
        try:
            data = await self._stream.receive(CHUNK)
        except anyio.EndOfStream:
            how = "in the middle of a message" if self._reader.is_within_frame else "its side"
            raise ConnectionLost(f"{self.peer} closed {how}") from None
        except (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError) as exc:
            raise ConnectionLost(f"the connection to {self.peer} broke") from exc
        return self._reader.feed(data)

    async def aclose(self) -> None:
        # A peer that does not take part in closing, or a line that is dead, must not be waited for.
        try:
            with anyio.move_on_after(1, shield=True):
                await self._stream.aclose()
        except (OSError, anyio.BrokenResourceError, anyio.ClosedResourceError):
            pass
