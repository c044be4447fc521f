"""The outcomes of goals that have ended, as `goals` shows them."""

from __future__ import annotations

import anyio
import pytest

from fibaction import ActionClient, GoalAborted, GoalStatus, UnknownGoal
from fibaction.cli.arguments.goal_lookup import goals_of
from fibaction.cli.output.goal_details import Outcomes
from fibaction.observe.monitor import AnyClient
from tests.cli.served import Altered, counter

pytestmark = pytest.mark.asyncio


async def test_goals_that_have_ended_have_a_reason_or_a_result() -> None:
    ends = (["done\x1b"], [GoalAborted("stuck")], [GoalAborted("")], [anyio.Event()])
    server = counter("count", *ends)
    async with server:
        client = ActionClient(server, server.action)
        for _ in range(3):
            await (await client.send_goal(1)).outcome()
        await client.send_goal(1)
        clients: dict[str, AnyClient] = {"count": client}
        rows = await goals_of(clients)
        whole = await Outcomes().of(clients, rows)
        assert [row.info for row in whole] == [row.info for row in rows]
        assert [row.end for row in whole] == ["done\\x1b", "stuck", "", ""]
        succeeded, aborted, empty, running = (row.outcome for row in whole)
        assert succeeded is not None
        assert (succeeded.status, succeeded.result) == (GoalStatus.SUCCEEDED, "done\x1b")
        assert aborted is not None
        assert empty is not None
        assert running is None

        newest = await Outcomes(1).of(clients, rows)
        assert [row.outcome is not None for row in newest] == [False, False, True, False]


async def test_a_server_that_does_not_give_an_outcome_is_left_with_its_list() -> None:
    async with counter("count", ["done"]) as server:
        altered = Altered(server)
        client = ActionClient(altered, server.action)
        await client.call(1)
        rows = await goals_of({"count": client})

        async def forgotten(goal_id: object) -> None:
            raise UnknownGoal(rows[0].info.goal_id)

        async def silent(goal_id: object) -> None:
            await anyio.sleep_forever()

        for answer in (forgotten, silent):
            altered.calls["get_result"] = answer
            assert await Outcomes().of({"count": client}, rows, 0.01) == rows


async def test_an_outcome_is_asked_for_once_while_its_goal_is_listed() -> None:
    async with counter("count", ["one"], ["two"]) as server:
        altered = Altered(server)
        client = ActionClient(altered, server.action)
        await client.call(1)
        await client.call(1)
        clients: dict[str, AnyClient] = {"count": client}
        rows = await goals_of(clients)
        kept = Outcomes()
        assert [row.end for row in await kept.of(clients, rows)] == ["one", "two"]

        async def forgotten(goal_id: object) -> None:
            raise UnknownGoal(rows[0].info.goal_id)

        altered.calls["get_result"] = forgotten
        assert [row.end for row in await kept.of(clients, rows)] == ["one", "two"]
        await kept.of(clients, rows[1:])
        assert [row.end for row in await kept.of(clients, rows)] == ["", "two"]
