"""`fibaction_transports._socket_lines.on_anyio`: connections as anyio has them."""

from __future__ import annotations

import socket
from typing import Any

import anyio
import pytest
from anyio.abc import SocketAttribute

from fibaction.wire.channel import Line
from fibaction.wire.frames import FrameReader
from fibaction.words.errors import ConnectionLost
from fibaction_transports._socket_lines.on_anyio import accept, peer_of
from tests.transports.tcp.servers import Named

pytestmark = pytest.mark.anyio


@pytest.fixture
def anyio_backend() -> str:
    """What is for trio runs that by itself."""
    return "asyncio"


async def test_a_peer_is_named_by_its_address_if_it_has_one() -> None:
    for family, address, name in (
        (socket.AF_INET, ("127.0.0.1", 5), "127.0.0.1:5"),
        (socket.AF_INET, None, "a peer that has left"),
        (socket.AF_UNIX, "", "a local process"),
    ):
        stream: Any = Named(family, address)
        assert peer_of(stream) == name


def test_whoever_connects_is_served_in_a_task_of_its_own() -> None:
    async def main() -> None:
        served: list[str] = []
        done = anyio.Event()

        async def echo(line: Line) -> None:
            served.append(line.peer)
            with pytest.raises(ConnectionLost):
                await line.run(lambda frames: [], list)
            await line.aclose()
            if len(served) == 2:
                done.set()

        async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(accept, listener, FrameReader, echo, tasks)
                port = listener.extra(SocketAttribute.local_port)
                with anyio.fail_after(30):
                    async with (
                        await anyio.connect_tcp("127.0.0.1", port) as one,
                        await anyio.connect_tcp("127.0.0.1", port) as other,
                    ):
                        names = {
                            f"127.0.0.1:{stream.extra(SocketAttribute.local_port)}"
                            for stream in (one, other)
                        }
                    await done.wait()
                tasks.cancel_scope.cancel()
        assert set(served) == names

    anyio.run(main, backend="trio")
