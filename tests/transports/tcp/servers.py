"""Servers to be reached, and whether they are."""

from __future__ import annotations

import socket
from typing import Any

import anyio
import anyio.lowlevel
import msgspec
import pytest
from anyio.abc import SocketAttribute

from fibaction import ActionError, ActionServer, TransportError, connect, serve
from fibaction_transports.tcp import TcpTransport, UnixTransport
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

SECRET = "correct-horse"


def new_server() -> ActionServer[Goal, Feedback, Result]:
    return ActionServer(FIBONACCI, fibonacci)


async def works(url: str | TcpTransport | UnixTransport, **settings: Any) -> bool:
    with anyio.fail_after(30):
        async with connect(url, FIBONACCI, **settings) as client:
            return await client.call(Goal(3)) == Result([0, 1, 1, 2])


async def refusal(where: str | TcpTransport | UnixTransport) -> str:
    """Return the text of the error with which no server begins there."""
    with pytest.raises(TransportError) as caught:
        async with serve(new_server(), where):
            raise AssertionError("the block must not run")
    return str(caught.value)


async def failure(kind: type[ActionError], *where: Any, **settings: Any) -> str:
    """Return the text of the error of that kind with which no client connects there."""
    with anyio.fail_after(30), pytest.raises(kind) as caught:
        async with connect(*where, **settings):
            raise AssertionError("the block must not run")
    return str(caught.value)


def tls_server(**files: str) -> str:
    query = "&".join(f"{name}={value}" for name, value in files.items())
    return f"tls://127.0.0.1:0?{query}"


class Named(msgspec.Struct):
    """As much of a stream as has a remote address."""

    family: socket.AddressFamily
    address: Any

    def extra(self, attribute: object, default: object = None) -> Any:
        if attribute is SocketAttribute.family:
            return self.family
        assert attribute is SocketAttribute.remote_address
        return self.address or default
