"""A fuzz target: the bytes that a hostile client sends to a server.

    make fuzz            # for a while; or: python -m tests.fuzz.wire -max_total_time=3600

The input is cut into pieces by its own first bytes, and goes through the real frames and a real
session with a real server behind it. Whatever it is, the session goes on or ends with an
`ActionError`; anything else is a finding. Needs atheris, which `make fuzz` installs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress

import anyio

from fibaction import ActionServer
from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.channel import Channel
from fibaction.wire.frames import FrameReader, header
from fibaction.wire.link import Link
from fibaction.wire.messages import VERSION, Hello, decode_from_client, decode_from_server, encode
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.session import Session
from fibaction.wire.settings import Limits, WireSettings
from fibaction.words.errors import ActionError, ConnectionLost, ProtocolError
from tests.fuzz.fuzzer import fuzz
from tests.support.fibonacci import FIBONACCI, fibonacci

LIMIT = 2**16
HELLO = encode(Hello(VERSION, 60.0))
LIMITS = Limits(goals=10, requests=10, memory=LIMIT)
TERMS = WireSettings(heartbeat=60.0, limits=LIMITS, grace=0)


class Given(Channel):
    """A channel on which the given bytes arrive in pieces, and sent bytes are discarded."""

    peer = "the fuzzer"

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces
        self._reader = FrameReader(LIMIT)

    async def send(self, frames: Sequence[bytes]) -> None:
        for frame in frames:
            decode_from_server(frame)  # a server always sends valid messages

    async def receive(self) -> list[bytes]:
        await anyio.lowlevel.checkpoint()
        for piece in self._pieces:
            if frames := self._reader.feed(piece):
                return frames
        raise ConnectionLost("that was all")

    async def aclose(self) -> None:
        pass


def pieces(data: bytes) -> Iterator[bytes]:
    """Return an optional hello, and the data in pieces, with a size taken from the data."""
    if not data:
        return
    size, data = data[0] or 1, data[1:]
    if size % 2:
        yield header(len(HELLO)) + HELLO
    for start in range(0, len(data), size):
        yield data[start : start + size]


async def serve(data: bytes) -> None:
    async with ActionServer(FIBONACCI, fibonacci) as server, anyio.create_task_group() as tasks:
        link = Link(Given(pieces(data)), 60.0)
        session = Session(
            link,
            {"fibonacci": server},
            TERMS,
            Owners(tasks, grace=0, limit=100),
            ByteBudget(2**20),
            clients_of=lambda action: [],
            entered=lambda session: None,
        )
        error = await session.run()
        assert isinstance(error, ActionError), error


def decode(data: bytes) -> None:
    for read in (decode_from_client, decode_from_server):
        with suppress(ProtocolError):
            read(data)


def one_input(data: bytes) -> None:
    decode(data)
    anyio.run(serve, data)


def main() -> None:
    fuzz("wire", one_input, logs=False)


if __name__ == "__main__":
    main()
