"""A client of fibaction uses stock servers of rclpy, in other processes.

`test_rclpy_list` tells which of rclpy's own tests are covered here and in `test_against_rclpy`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from time import perf_counter
from typing import Any, TypeAlias, cast

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    CancelCode,
    ClientConnection,
    GoalAborted,
    GoalID,
    GoalRejected,
    GoalStatus,
    ServerNotFound,
    UnknownGoal,
    connect,
)
from tests.ros2.stock import orders
from tests.ros2.stock.ours import TYPE, action
from tests.ros2.stock.process import peer
from tests.ros2.stock.tutorial_server import STEP
from tests.ros2.stock.waiting import eventually
from tests.ros2.zenoh_peer import middleware, url_of
from tests.support.fibonacci import Feedback, Goal, Result
from tests.support.matching import End

pytestmark = pytest.mark.anyio

Client: TypeAlias = ActionClient[Goal, Feedback, Result]

AT_ONCE = 500
PARTLY = Result(orders.PART)


@pytest.fixture(scope="module", params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(scope="module")
async def connection(anyio_backend: str, way: str) -> AsyncGenerator[ClientConnection, None]:
    """To a stock server, and to that of the tutorial."""
    url = url_of(way, "our_client")
    nodes = middleware(way)
    async with (
        peer("server", **nodes),
        peer("tutorial_server", **nodes),
        connect(url) as found,
    ):
        for name in ("stock", "stock_hasty", "tutorial"):
            await found.client(action(name)).wait_for_server(20)
        yield found


@pytest.fixture(scope="module")
def client(connection: ClientConnection) -> Client:
    return connection.client(action("stock"))


@pytest.fixture(scope="module")
def hasty(connection: ClientConnection) -> Client:
    return connection.client(action("stock_hasty"))


@pytest.fixture(scope="module")
def tutorial(connection: ClientConnection) -> Client:
    return connection.client(action("tutorial"))


async def release(client: Client) -> None:
    await client.call(Goal(orders.RELEASES))


# A goal and its end


async def test_feedback_arrives_in_order_and_the_result_after_it(client: Client) -> None:
    async with client.send_goal(Goal(5)) as goal:
        feedback = [one.partial_sequence async for one in goal.feedback]
        sent = [0, 1, 1, 2, 3, 5]
        assert feedback == [sent[:3], sent[:4], sent[:5], sent]
        assert await goal.result() == Result(sent)
    assert goal.status is GoalStatus.SUCCEEDED
    assert goal.stamp > 1.7e18


async def test_a_rejection_is_raised(client: Client) -> None:
    with pytest.raises(GoalRejected) as caught:
        await client.send_goal(Goal(orders.REJECTED))

    assert caught.value.goal_id is not None
    with pytest.raises(UnknownGoal):
        await client.attach(caught.value.goal_id)


@pytest.mark.promise("ERROR-2")
async def test_an_abort_comes_with_the_part_that_is_done(client: Client) -> None:
    with pytest.raises(GoalAborted) as caught:
        await client.call(Goal(orders.ABORTS))

    assert caught.value.result == PARTLY


async def test_a_callback_that_raises_is_an_abort_without_a_result(client: Client) -> None:
    goal = await client.send_goal(Goal(orders.RAISES))

    assert await goal.outcome() == End(GoalStatus.ABORTED, None)


async def test_several_goals_run_side_by_side_and_each_gets_its_own(client: Client) -> None:
    waiting = await client.send_goal(Goal(orders.WAITS))
    goals = [await client.send_goal(Goal(order)) for order in (3, 4)]

    lengths = [[len(one.partial_sequence) async for one in goal.feedback] for goal in goals]

    assert lengths == [[3, 4], [3, 4, 5]]
    assert [len((await goal.result()).sequence) for goal in goals] == [4, 5]
    await waiting.cancel()
    assert [one.partial_sequence async for one in waiting.feedback] == [[1]]


async def test_500_goals_at_once_all_succeed(tutorial: Client) -> None:
    results: list[Result] = []

    async def call() -> None:
        results.append(await tutorial.call(Goal(1)))

    async with anyio.create_task_group() as tasks:
        for _ in range(AT_ONCE):
            tasks.start_soon(call)

    assert results == [Result([0, 1])] * AT_ONCE


# Canceling


async def test_an_accepted_cancel_ends_the_goal_with_the_part_that_is_done(client: Client) -> None:
    async with client.send_goal(Goal(orders.WAITS)) as goal:
        async for one in goal.feedback:
            assert one == Feedback([1])
            answer = await goal.cancel()

        assert answer.return_code is CancelCode.NONE
        assert [(info.goal_id, info.status) for info in answer.goals_canceling] == [
            (goal.goal_id, GoalStatus.CANCELING)
        ]
        assert await goal.outcome() == End(GoalStatus.CANCELED, PARTLY)


async def test_a_rejected_cancel_is_reported_and_the_goal_goes_on(
    client: Client,
) -> None:
    goal = await client.send_goal(Goal(orders.STUBBORN))
    assert await anext(goal.feedback) == Feedback([1])

    answer = await goal.cancel()

    assert answer.return_code is CancelCode.REJECTED
    assert not answer.accepted
    await release(client)
    assert await goal.result() == PARTLY


async def test_canceling_all_and_by_time(client: Client) -> None:
    goals = [await client.send_goal(Goal(orders.WAITS)) for _ in range(3)]

    # rclpy tells its clients a stamp some microseconds before the one that it compares.
    by_time = await client.cancel_goals(before=goals[2].stamp - 1)
    the_rest = await client.cancel_goals()

    canceled = {info.goal_id for info in by_time.goals_canceling}
    assert canceled == {goal.goal_id for goal in goals[:2]}
    assert [info.goal_id for info in the_rest.goals_canceling] == [goals[2].goal_id]
    for goal in goals:
        assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_a_cancel_of_nothing_has_the_code_of_rcl(client: Client) -> None:
    over = await client.send_goal(Goal(2))
    await over.result()

    unknown = await client.cancel_goals(GoalID.random())
    terminated = await client.cancel_goals(over.goal_id)
    nothing = await client.cancel_goals()

    assert unknown.return_code is CancelCode.UNKNOWN_GOAL_ID
    assert terminated.return_code is CancelCode.GOAL_TERMINATED
    assert nothing.return_code is CancelCode.NONE
    assert not nothing.accepted


# Deferred execution


async def test_a_goal_whose_execution_is_deferred_is_accepted_until_then(client: Client) -> None:
    goal = await client.send_goal(Goal(orders.DEFERRED))
    await client.call(Goal(2))  # by then, an execution would have been seen
    assert goal.status is GoalStatus.ACCEPTED

    await release(client)

    assert await goal.result() == PARTLY


async def test_a_goal_whose_execution_is_deferred_can_be_canceled(client: Client) -> None:
    goal = await client.send_goal(Goal(orders.DEFERRED))

    answer = await goal.cancel()

    assert answer.accepted
    await release(client)
    assert await goal.outcome() == End(GoalStatus.CANCELED, PARTLY)


# Later


@pytest.mark.promise("FEEDBACK-10")
async def test_a_goal_can_be_followed_by_another_client(client: Client) -> None:
    sent = await client.send_goal(Goal(orders.STUBBORN))
    assert await anext(sent.feedback) == Feedback([1])

    goal = await client.attach(sent.goal_id)

    assert goal.status is GoalStatus.EXECUTING
    await release(client)
    assert await goal.result() == await sent.result() == PARTLY


async def test_a_result_is_there_late_until_it_expires(client: Client, hasty: Client) -> None:
    goals = [await of.send_goal(Goal(3)) for of in (client, hasty)]
    for goal in goals:
        await goal.result()

    assert await (await client.attach(goals[0].goal_id)).result() == Result([0, 1, 1, 2])

    async def is_unknown() -> bool:
        try:
            await hasty.attach(goals[1].goal_id)
        except UnknownGoal:
            return True
        return False

    await eventually(is_unknown, bool)  # nothing is published when rclpy forgets a goal


async def test_the_statuses_of_all_goals_can_be_followed(client: Client) -> None:
    with await client.endpoint.status() as statuses:
        sent = await client.send_goal(Goal(orders.WAITS))
        seen: list[GoalStatus] = []
        while not (seen and seen[-1].is_terminal):
            info = await statuses.receive()
            assert info is not None
            if info.goal_id == sent.goal_id:
                seen.append(info.status)
                if info.status is GoalStatus.EXECUTING:  # rclpy may cancel a goal before that
                    await sent.cancel()

    assert seen == [
        GoalStatus.ACCEPTED,
        GoalStatus.EXECUTING,
        GoalStatus.CANCELING,
        GoalStatus.CANCELED,
    ]


# Finding a server


async def test_a_server_that_is_there_is_found_at_once(client: Client) -> None:
    start = perf_counter()
    await client.wait_for_server()
    assert perf_counter() - start < 0.25  # rclpy looks once in that time


async def test_a_server_that_is_not_there_is_not_found(way: str) -> None:
    where = url_of(way, "another")
    async with connect(where, action("missing"), discovery_timeout=0.3) as missing:
        start = perf_counter()
        with pytest.raises(ServerNotFound, match="missing"):
            await missing.wait_for_server(0.3)
        assert 0.3 <= perf_counter() - start < 1.5

        with pytest.raises(ServerNotFound, match="no server of the action 'missing' in ROS"):
            await missing.send_goal(Goal(1))


@pytest.mark.promise("REACH-3")
async def test_actions_are_listed_with_their_types(connection: ClientConnection) -> None:
    infos = {info.name: info.type_name for info in await connection.actions()}

    assert infos == dict.fromkeys(("stock", "stock_hasty", "stock_usual", "tutorial"), TYPE)


class OtherFeedback(msgspec.Struct):
    sequence: list[int]


@pytest.mark.promise("ACCEPT-3")
async def test_a_goal_of_another_type_is_rejected_before_it_is_sent(client: Client) -> None:
    with pytest.raises(GoalRejected, match='goal has no field "sequence"'):
        await client.send_goal(cast("Goal", Result([1])))


@pytest.mark.promise("REACH-1")
async def test_an_action_of_another_type_under_the_same_name_finds_no_server(
    client: Client, way: str
) -> None:
    other = Action(
        "stock",
        goal=Goal,
        feedback=OtherFeedback,
        result=Result,
        type_name="test_msgs/action/Fibonacci",
    )
    where = url_of(way, "another")
    async with connect(where, other, discovery_timeout=0.5) as stranger:
        with pytest.raises(ServerNotFound):
            await stranger.send_goal(Goal(1))
    assert await client.call(Goal(2)) == Result([0, 1, 1])


# The server of the tutorial, which blocks, and has no callback for cancels


async def test_the_tutorial_gives_feedback_and_a_result(tutorial: Client) -> None:
    start = perf_counter()
    async with tutorial.send_goal(Goal(4)) as goal:
        times = [perf_counter() - start async for _ in goal.feedback]
        assert await goal.result() == Result([0, 1, 1, 2, 3])

    assert len(times) == 3
    assert times[0] < perf_counter() - start - STEP  # it did not come with the result


async def test_the_tutorial_rejects_a_cancel_and_that_is_reported(tutorial: Client) -> None:
    async with tutorial.send_goal(Goal(4)) as goal:
        assert await anext(goal.feedback) == Feedback([0, 1, 1])

        # While it executes, its only thread answers nothing; then the goal has ended.
        answer = await goal.cancel()
        assert answer.return_code in (CancelCode.REJECTED, CancelCode.GOAL_TERMINATED)
        assert not answer.accepted

        assert await goal.result() == Result([0, 1, 1, 2, 3])
