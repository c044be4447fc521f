"""`GET .../log`: the log records of a goal's executor."""

from __future__ import annotations

import pytest

from fibaction import GoalID, Peer, Permission, serve
from fibaction.border.abc import ForwardingEndpoint, LogLine
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

GOALS = "/actions/fibonacci/goals"
GOAL_ID = GoalID.random()


class Logging(ForwardingEndpoint):
    """A server with the lines of one goal."""

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return [LogLine(7, "INFO", "arm", "grips")] if goal_id == GOAL_ID else None


async def test_the_lines_of_a_goal_are_told_to_those_who_may_observe() -> None:
    may = {Permission.OBSERVE}

    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission in may

    async with serve(Logging(new_server()), "http://127.0.0.1:0", authorize=authorize) as (url,):
        told = await fetch(url, "GET", f"{GOALS}/{GOAL_ID}/log")
        line = {"at": "7", "level": "INFO", "logger": "arm", "text": "grips"}
        assert (told.status, told.json) == (200, {"lines": [line]})
        none = await fetch(url, "GET", f"{GOALS}/{GoalID.random()}/log")
        assert (none.status, none.json) == (200, {"lines": None})
        may.clear()
        assert (await fetch(url, "GET", f"{GOALS}/{GOAL_ID}/log")).status == 403
