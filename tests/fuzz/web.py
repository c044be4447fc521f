"""A fuzz target: the bytes of a hostile client of HTTP.

    python -m tests.fuzz.web -max_total_time=600

The input arrives in pieces, of a size that its own first byte gives, and goes through the real
server of HTTP and the real application to a real action server. Whatever it is, the connection
ends, and the log has no error, which would be a bug. Needs atheris, which `make fuzz` installs.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import anyio
from anyio.abc import ByteStream, SocketAttribute

from fibaction import ActionServer
from fibaction.border.http_access import rules
from fibaction.wire.settings import Limits, WireSettings
from fibaction.wire.wire_server import open_server
from fibaction_transports.web.http.application import WebApplication
from fibaction_transports.web.http_transport import WebServer
from fibaction_transports.web.rosbridge.server.channel import RosbridgeGuest
from tests.fuzz.fuzzer import fuzz, run_without_errors
from tests.support.fibonacci import FIBONACCI, fibonacci

LIMITS = Limits(frame=2**12, handshake=0.05)
RULES = rules("127.0.0.1", "/", hosts=(), origins=(), has_tls=False)


class Given(ByteStream):
    """A stream on which the given bytes arrive in pieces, and sent bytes are discarded."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces = pieces

    @property
    def extra_attributes(self) -> Mapping[Any, Callable[[], Any]]:
        return {SocketAttribute.family: lambda: socket.AF_UNIX}

    async def receive(self, max_bytes: int = 65536) -> bytes:
        await anyio.lowlevel.checkpoint()
        for piece in self._pieces:
            return piece
        raise anyio.EndOfStream

    async def send(self, item: bytes) -> None:
        await anyio.lowlevel.checkpoint()

    async def send_eof(self) -> None:
        pass

    async def aclose(self) -> None:
        pass


async def serve(data: bytes) -> None:
    size, data = (data[0] or 1) if data else 1, data[1:]
    pieces = (data[start : start + size] for start in range(0, len(data), size))
    async with (
        ActionServer(FIBONACCI, fibonacci, max_goals=4) as server,
        open_server({"fibonacci": server}, WireSettings(limits=LIMITS)) as wire,
    ):
        application = WebApplication(wire, RULES, RosbridgeGuest())
        await WebServer(application, "http").serve(Given(pieces))
        await application.close()


def one_input(data: bytes) -> None:
    run_without_errors(serve, data)


def main() -> None:
    fuzz("web", one_input)


if __name__ == "__main__":
    main()
