"""Streams over the sockets that a server accepts."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import anyio
import pytest
from anyio.abc import SocketAttribute

from fibaction_transports._socket_lines.sockets import SocketStream, peer_of

pytestmark = pytest.mark.anyio

LARGE = 2**22
"""More bytes than sockets hold."""


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair()
    for end in (ours, theirs):
        end.setblocking(False)
    with ours, theirs:
        yield ours, theirs


async def test_more_than_a_socket_holds_arrives_whole(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    ours, theirs = (SocketStream(end) for end in ends)
    arrived = bytearray()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(ours.send, bytes(range(256)) * (LARGE // 256))
        while len(arrived) < LARGE:
            arrived += await theirs.receive()
    assert arrived == bytes(range(256)) * (LARGE // 256)


async def test_a_stream_that_waits_ends_when_it_is_closed(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    ours = SocketStream(ends[0])
    waits = anyio.Event()

    async def receive() -> None:
        waits.set()
        with pytest.raises(anyio.ClosedResourceError):
            await ours.receive()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(receive)
        await waits.wait()
        await anyio.wait_all_tasks_blocked()
        await ours.aclose()
        await ours.aclose()
    assert ends[0].fileno() == -1


async def test_a_peer_has_its_address_until_it_has_reset_the_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        client = socket.create_connection(listening.getsockname())
        accepted, address = listening.accept()
        with client, accepted:
            stream = SocketStream(accepted)
            assert stream.extra(SocketAttribute.family) is socket.AF_INET
            assert peer_of(stream) == f"{address[0]}:{address[1]}"
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            client.close()
            accepted.setblocking(False)
            await anyio.wait_readable(accepted)
            assert peer_of(stream) == "a peer that has left"
