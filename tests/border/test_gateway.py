"""The border of gateways: the group of servers in this process, and a transport without an end."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, NoReturn

import anyio
import pytest

from fibaction import TransportError, serve
from fibaction.border.gateway import Gateway, GatewayTransport, ServerGroup, group_of
from tests.cli.served import counter

pytestmark = pytest.mark.asyncio


class Board(Gateway):
    """A gateway whose clients see the names of the actions."""

    def __init__(self, group: ServerGroup) -> None:
        self.group = group

    @property
    def url(self) -> str:
        return "board://here"

    @property
    def names(self) -> list[str]:
        return [info.name for seen in self.group.servers.values() for info in seen.actions]


class BoardTransport(GatewayTransport):
    def __init__(self) -> None:
        self.boards: list[Board] = []

    @classmethod
    def from_url(cls, url: str, **settings: Any) -> BoardTransport:
        raise NotImplementedError

    def connect(self) -> NoReturn:
        raise NotImplementedError

    @asynccontextmanager
    async def serve_group(self, group: ServerGroup) -> AsyncGenerator[Gateway, None]:
        board = Board(group)
        self.boards.append(board)
        yield board


async def test_servers_of_this_process_are_a_group() -> None:
    transport = BoardTransport()
    one, two = counter("one"), counter("two")
    async with serve((one, two), transport) as (url,):
        assert url == "board://here"
        (board,) = transport.boards
        assert board.names == ["one", "two"]
        assert board.group.problems == {"": ""}
        seen = board.group.servers[""]
        assert seen.connection.endpoint(two.info) is two
        assert await seen.connection.actions() == list(seen.actions)


async def test_two_actions_of_one_name_are_an_error() -> None:
    with pytest.raises(TransportError, match="two of the endpoints"):
        group_of([counter("one"), counter("one")])


async def test_a_transport_does_not_end_by_itself() -> None:
    with anyio.move_on_after(0.01) as scope:
        await BoardTransport().wait_end()
    assert scope.cancelled_caught
