"""`POST .../rerun`: an operator runs a goal again that was given up."""

from __future__ import annotations

import pytest

from fibaction import GoalID, Peer, Permission, serve
from fibaction.border.abc import ForwardingEndpoint
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

GOALS = "/actions/fibonacci/goals"
OLD_ID, NEW_ID = GoalID.random(), GoalID.random()


class Again(ForwardingEndpoint):
    """A server that has given up one goal."""

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return NEW_ID if goal_id == OLD_ID else None


async def test_an_operator_gets_the_id_of_the_new_goal_if_the_old_one_was_given_up() -> None:
    may = {Permission.OBSERVE}

    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission in may

    async with serve(Again(new_server()), "http://127.0.0.1:0", authorize=authorize) as (url,):
        assert (await fetch(url, "POST", f"{GOALS}/{OLD_ID}/rerun")).status == 403
        may.add(Permission.OPERATE)
        answer = await fetch(url, "POST", f"{GOALS}/{OLD_ID}/rerun")
        assert (answer.status, answer.json) == (201, {"goal_id": str(NEW_ID)})
        assert answer.headers["location"].endswith(f"{GOALS}/{NEW_ID}")
        again = await fetch(url, "POST", f"{GOALS}/{NEW_ID}/rerun")
        assert (again.status, "was not given up" in again.json["detail"]) == (409, True)
