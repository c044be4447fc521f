"""The ends of a simulated connection as asyncio has them: a transport that calls a protocol.

It is for `ProtocolLine`, which TCP and Unix sockets use on asyncio, and behaves like a transport
over a socket: it passes on the bytes that arrive, buffers those that the line cannot take yet, and
pauses and resumes writing. It does not interpret the bytes.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # it is a transport of asyncio
from collections.abc import Callable
from contextvars import copy_context
from typing import Any

from fibaction.border.event_loop import asyncio_loop
from fibaction.wire.channel import CHUNK
from fibaction.wire.frames import FrameReader
from fibaction_transports._socket_lines.protocol_line import ProtocolLine
from tests.simulation.streams import SimulatedStream


class Socket(asyncio.Transport):
    """One end of a connection."""

    def __init__(self, stream: SimulatedStream, protocol: ProtocolLine) -> None:
        super().__init__()
        self._stream = stream
        self._protocol = protocol
        self._incoming, self._outgoing = stream.ways
        self._loop = asyncio_loop()  # so that its callbacks are known to be asyncio's
        self._context = copy_context()
        self._buffer = bytearray()
        self._reads = True
        self._is_paused = False
        self._peer_is_gone = False
        self._has_told_end = False
        self._is_lost = False
        self._is_due = False
        self._incoming.on_arrival = self._outgoing.on_room = self._stir
        protocol.connection_made(self)
        self._stir()

    def _soon(self, function: Callable[..., Any], *args: Any) -> None:
        self._loop.call_soon(function, *args, context=self._context)

    def _stir(self) -> None:
        if not self._is_due and not self._is_lost:
            self._is_due = True
            self._soon(self._look)

    def _look(self) -> None:
        self._is_due = False
        if self._is_lost:
            return
        if self._incoming.is_broken:
            self._lose(ConnectionResetError(104, "Connection reset by peer"))
            return
        if self._buffer and not self._outgoing.is_full:
            self._outgoing.send(bytes(self._buffer))
            self._buffer.clear()
        if self._is_paused and not self._buffer:
            self._is_paused = False
            self._protocol.resume_writing()
        if self._reads and self._incoming.has_bytes:
            buffer = self._protocol.get_buffer(-1)
            data = self._incoming.take(len(buffer))
            buffer[: len(data)] = data
            self._protocol.buffer_updated(len(data))
            self._stir()
        elif self._reads and self._incoming.has_ended and not self._has_told_end:
            self._has_told_end = True
            if not self._protocol.eof_received():
                self.close()

    def _lose(self, error: Exception | None) -> None:
        """Tell the protocol once, in a turn of its own, that the connection is lost."""
        if not self._is_lost:
            self._is_lost = True
            self._stream.close_now()
            self._stream.forget_callbacks()  # as a real transport forgets its protocol
            self._soon(self._protocol.connection_lost, error)

    # What the protocol calls

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        host, _, port = self._stream.peer.partition(":")
        return (host, port) if name == "peername" else default

    def is_closing(self) -> bool:
        return self._is_lost

    def write(self, data: Any) -> None:
        if self._is_lost:
            return
        if self._peer_is_gone:  # what was written after its end was answered with a reset
            self._lose(BrokenPipeError(32, "Broken pipe"))
            return
        self._peer_is_gone = self._incoming.has_ended
        if self._buffer or self._outgoing.is_full:
            self._buffer += data
            if not self._is_paused:
                self._is_paused = True
                self._protocol.pause_writing()
        else:
            self._outgoing.send(bytes(data))

    def get_write_buffer_size(self) -> int:
        return len(self._buffer)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        assert high == 0, "this transport can only count every byte"

    def pause_reading(self) -> None:
        self._reads = False

    def resume_reading(self) -> None:
        self._reads = True
        self._stir()

    def abort(self) -> None:
        self._lose(None)

    def close(self) -> None:
        self._lose(None)


def line_over(stream: SimulatedStream, reader: FrameReader, peer: str = "") -> ProtocolLine:
    """Return one end of a connection, as the transports for TCP and Unix sockets have it."""
    line = ProtocolLine(reader, memoryview(bytearray(CHUNK)), peer)
    Socket(stream, line)
    return line
