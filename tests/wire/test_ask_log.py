"""The log of a goal over the wire: permissions, and servers that keep none or are older."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction import ActionServer, AuthenticationFailed, GoalID, Peer, Permission, connect, serve
from fibaction.border.abc import ForwardingEndpoint, LogLine
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.server import session
from tests.support.fibonacci import FIBONACCI, fibonacci

pytestmark = pytest.mark.anyio

TCP = "tcp://127.0.0.1:0"
GOAL_ID, OTHER = GoalID.random(), GoalID.random()
LINES = [LogLine(1, "INFO", "arm", "grips"), LogLine(2, "ERROR", "arm", "is stuck")]


class Logging(ForwardingEndpoint):
    """A server with the lines of one goal."""

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return {GOAL_ID: LINES, OTHER: []}.get(goal_id)


@pytest.fixture
def server() -> Any:
    return Logging(ActionServer(FIBONACCI, fibonacci))


async def test_the_lines_of_a_goal_are_told(server: Any) -> None:
    async with serve(server, TCP) as (url,), connect(url, FIBONACCI) as client:
        asked = (GOAL_ID, OTHER, GoalID.random())
        assert [await client.endpoint.log_lines(one) for one in asked] == [LINES, [], None]


async def test_they_are_told_to_clients_that_may_observe(server: Any) -> None:
    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission is not Permission.OBSERVE

    async with serve(server, TCP, authorize=authorize) as (url,):
        async with connect(url, FIBONACCI) as client:
            with pytest.raises(AuthenticationFailed, match="may not observe"):
                await client.endpoint.log_lines(GOAL_ID)


async def test_a_server_of_an_earlier_version_is_not_asked(
    server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "NEWEST_FROM_CLIENT", 29)
    async with serve(server, TCP) as (url,), connect(url, FIBONACCI) as client:
        assert await client.endpoint.log_lines(GOAL_ID) is None


async def test_before_the_first_connection_nothing_is_known() -> None:
    assert await OpenCalls(9, 9).log_lines("drive", GOAL_ID) is None
