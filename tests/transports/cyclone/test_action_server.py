"""Our action server over `dds://`, and clients of Cyclone DDS as rmw_cyclonedds_cpp makes them."""

from __future__ import annotations

import anyio
import pytest

from fibaction import serve
from tests.ros2.stock import orders
from tests.ros2.stock.process import Peer
from tests.support.fibonacci import Feedback, Goal, Result
from tests.transports.cyclone import dds_end
from tests.transports.cyclone.dds_end import NINE, cyclone_client, new_name
from tests.transports.cyclone.partner import needs_cyclone

pytestmark = [pytest.mark.anyio, needs_cyclone]

NINE_TERMS = [NINE[: size + 2] for size in range(1, 9)]


async def test_goals_of_a_cyclone_client_succeed_abort_and_are_rejected() -> None:
    name = new_name()
    async with serve(dds_end.server(name), "dds://"), cyclone_client(name) as cyclone:
        sent = await cyclone.ask("send", order=9)
        assert sent["accepted"]
        assert await cyclone.ask("result", goal=sent["goal"]) == {"status": 4, "sequence": NINE}
        assert await cyclone.ask("feedback", goal=sent["goal"], count=8) == NINE_TERMS
        assert (await cyclone.ask("status", goal=sent["goal"], status=4))[-1] == 4
        assert not (await cyclone.ask("send", order=-1))["accepted"]
        sent = await cyclone.ask("send", order=orders.ABORTS)
        outcome = await cyclone.ask("result", goal=sent["goal"])
        assert outcome == {"status": 6, "sequence": orders.PART}


async def test_a_cyclone_client_cancels_one_goal_and_gets_its_partial_result() -> None:
    name = new_name()
    async with serve(dds_end.server(name), "dds://"), cyclone_client(name) as cyclone:
        goals = [(await cyclone.ask("send", order=orders.WAITS))["goal"] for _ in range(2)]
        await cyclone.ask("feedback", goal=goals[0], count=1)
        assert await cyclone.ask("cancel", goal=goals[0]) == {"code": 0, "goals": [goals[0]]}
        outcome = await cyclone.ask("result", goal=goals[0])
        assert outcome == {"status": 5, "sequence": orders.PART}
        seen = await cyclone.ask("status", goal=goals[0], status=5)
        assert 2 in seen
        assert sorted(seen) == seen
        answer = await cyclone.ask("cancel", goal="00" * 16)
        assert answer == {"code": 0, "goals": [goals[1]]}


async def test_many_goals_of_a_cyclone_client_at_once_all_end() -> None:
    name = new_name()
    async with serve(dds_end.server(name), "dds://"), cyclone_client(name) as cyclone:
        answers = await cyclone.ask("many", orders=[1, 3, 5, 7, 9])
        expected = [NINE[: order + 1] for order in (1, 3, 5, 7, 9)]
        assert answers == [{"status": 4, "sequence": sequence} for sequence in expected]
        assert await cyclone.ask("repeated") == 0


async def test_clients_of_both_forms_each_get_their_own_answers_of_one_server() -> None:
    name = new_name()
    async with (
        serve(dds_end.server(name), "dds://"),
        cyclone_client(name) as cyclone,
        cyclone_client(name) as other,
        dds_end.client(name) as client,
    ):
        outcomes: dict[str, object] = {}

        async def ask(kind: str, peer: Peer) -> None:
            outcomes[kind] = await peer.ask("many", orders=[9] * 8)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(ask, "one", cyclone)
            tasks.start_soon(ask, "other", other)
            for _ in range(8):
                goal = await client.send_goal(Goal(9))
                feedback = [each async for each in goal]
                assert feedback == [Feedback(terms) for terms in NINE_TERMS]
                assert await goal.result() == Result(NINE)
        assert outcomes["one"] == outcomes["other"] == [{"status": 4, "sequence": NINE}] * 8
        assert await cyclone.ask("repeated") == await other.ask("repeated") == 0


async def test_a_cyclone_client_that_was_killed_does_not_stop_the_others() -> None:
    name = new_name()
    async with serve(dds_end.server(name), "dds://"), cyclone_client(name) as cyclone:
        async with cyclone_client(name) as other:
            await other.ask("send", order=orders.WAITS)
            other.process.kill()
            assert (
                await cyclone.ask("many", orders=[9] * 5) == [{"status": 4, "sequence": NINE}] * 5
            )
