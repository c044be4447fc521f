"""Our action client over `dds://`, and servers of Cyclone DDS as rmw_cyclonedds_cpp makes them."""

from __future__ import annotations

import anyio
import pytest

from fibaction import GoalAborted, GoalCanceled, GoalRejected, GoalStatus, serve
from tests.ros2.stock import orders
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import Feedback, Goal, Result
from tests.transports.cyclone import dds_end
from tests.transports.cyclone.dds_end import NINE, cyclone_server, new_name
from tests.transports.cyclone.partner import needs_cyclone

pytestmark = [pytest.mark.anyio, needs_cyclone]


async def test_goals_at_a_cyclone_server_succeed_abort_and_are_rejected_and_canceled() -> None:
    name = new_name()
    async with cyclone_server(name), dds_end.client(name) as client:
        goal = await client.send_goal(Goal(9))
        feedback = [each.partial_sequence async for each in goal]
        assert feedback == [NINE[: size + 2] for size in range(1, 9)]
        assert await goal.result() == Result(NINE)
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(-1))
        with pytest.raises(GoalAborted) as aborted:
            await client.call(Goal(orders.ABORTS))
        assert aborted.value.result == Result(orders.PART)
        goal = await client.send_goal(Goal(orders.WAITS))
        assert await anext(aiter(goal)) == Feedback([1])
        await goal.cancel()
        with pytest.raises(GoalCanceled) as canceled:
            await goal.result()
        assert canceled.value.result == Result(orders.PART)
        assert goal.status is GoalStatus.CANCELED


async def test_the_first_goal_after_the_server_was_found_is_answered() -> None:
    name = new_name()
    async with cyclone_server(name):
        for _ in range(5):
            async with dds_end.client(name) as client:
                with anyio.fail_after(30):
                    assert await client.call(Goal(9)) == Result(NINE)


async def test_many_goals_at_once_at_a_cyclone_server_all_end_and_none_runs_twice() -> None:
    name = new_name()
    results: list[Result] = []
    async with cyclone_server(name) as cyclone, dds_end.client(name) as client:

        async def call() -> None:
            results.append(await client.call(Goal(9)))

        async with anyio.create_task_group() as tasks:
            for _ in range(8):
                tasks.start_soon(call)
        assert results == [Result(NINE)] * 8
        offered = await cyclone.ask("offered")
        assert len(offered) == len(set(offered)) == 8


async def test_two_clients_of_ours_at_a_cyclone_server_each_get_their_own_answers() -> None:
    name = new_name()
    async with (
        cyclone_server(name),
        dds_end.client(name) as one,
        dds_end.client(name) as other,
        anyio.create_task_group() as tasks,
    ):

        async def call(order: int) -> None:
            client = one if order % 2 else other
            for _ in range(5):
                assert await client.call(Goal(order)) == Result(NINE[: order + 1])

        for order in range(1, 9):
            tasks.start_soon(call, order)


async def test_a_goal_reaches_servers_of_both_forms_and_is_answered_by_either() -> None:
    name = new_name()
    ours: list[int] = []
    async with (
        serve(dds_end.server(name, ours.append), "dds://"),
        cyclone_server(name) as cyclone,
        dds_end.client(name) as client,
    ):
        theirs: list[str] = []
        while not (ours and theirs):  # one of the two may be found later
            assert await client.call(Goal(9)) == Result(NINE)
            theirs = await cyclone.ask("offered")
        found = len(theirs)
        for _ in range(10):
            assert await client.call(Goal(8)) == Result(NINE[:-1])

        async def offered() -> tuple[int, int]:
            theirs = await cyclone.ask("offered")
            assert len(theirs) == len(set(theirs))
            return ours.count(8), len(theirs)

        # The last goal before these may have been answered by one, and come to the other later.
        await eventually(offered, lambda now: now in ((10, found + 10), (10, found + 11)))
