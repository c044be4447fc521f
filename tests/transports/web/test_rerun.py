"""`POST .../rerun`: an operator runs a goal again that was given up."""

from __future__ import annotations

from typing import Any, cast

import pytest

from fibaction import GoalID, Peer, Permission, serve
from fibaction.border.abc import ForwardingEndpoint, GoalStream
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


class GivenUp(ForwardingEndpoint):
    """A server that has given up each of its goals at a checkpoint."""

    checkpoint = b""

    async def feedback(self, *arguments: Any, **more: Any) -> GoalStream:
        stream: Any = await super().feedback(*arguments, **more)
        stream.checkpoint = self.checkpoint
        return cast("GoalStream", stream)


async def test_the_details_of_a_goal_that_was_given_up_have_its_checkpoint_for_observers() -> None:
    may = {Permission.SEND, Permission.OBSERVE}

    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission in may

    robot = GivenUp(new_server())
    tokens = {"secret": "ann"}
    async with serve(robot, "http://127.0.0.1:0", authorize=authorize, tokens=tokens) as (url,):
        ann = {"Authorization": "Bearer secret"}
        sent = await fetch(url, "POST", f"{GOALS}?wait=9", {"order": 2}, **ann)
        path = f"{GOALS}/{sent.json['goal_id']}"
        assert "checkpoint" not in sent.json
        for robot.checkpoint, told in ((b"", None), (b"\x04", 4), (b"\xc1", None)):
            assert (await fetch(url, "GET", path, **ann)).json["checkpoint"] == told
        may.remove(Permission.OBSERVE)
        own = await fetch(url, "GET", path, **ann)
        assert (own.status, "checkpoint" in own.json) == (200, False)
