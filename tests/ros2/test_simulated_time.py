"""The clock of a simulation: stamps and cancels by time, while it jumps or stands still."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from action_msgs.srv import CancelGoal
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock

from fibaction import ActionClient, ActionServer, ClientGoal, GoalID, connect, serve
from fibaction_transports.ros2 import Ros2Transport
from fibaction_transports.ros2.node import stamps
from fibaction_transports.ros2.node.stamps import (
    FIRST_STAMP,
    LAST_STAMP,
    FollowedStamps,
    ServedStamps,
)
from fibaction_transports.ros2.on_rclpy.rclpy_node import NodeClock
from tests.ros2.ends import forever, new_url
from tests.ros2.spun import spun_node
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.processes import PATIENCE

pytestmark = pytest.mark.anyio

SECOND = 10**9
SIMULATED = ("--ros-args", "-p", "use_sim_time:=true")


class Simulation:
    """A clock, a server, a client, and a client of rclpy that cancels."""

    def __init__(
        self, stock: Any, clocks: list[Any], client: ActionClient[Goal, Feedback, Result]
    ) -> None:
        self.client = client
        self._clocks = clocks
        self._publisher = stock.create_publisher(Clock, "/clock", 10)
        self._cancels = stock.create_client(CancelGoal, "fibonacci/_action/cancel_goal")

    async def set_time(self, seconds: float) -> None:
        sec, nanosec = divmod(int(seconds * SECOND), SECOND)

        async def seen() -> set[int]:
            self._publisher.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
            return {clock.now().nanoseconds for clock in self._clocks}

        await eventually(seen, lambda times: times == {sec * SECOND + nanosec})

    async def goal_at(self, seconds: float) -> ClientGoal[Feedback, Result]:
        await self.set_time(seconds)
        return await self.client.send_goal(Goal(1))

    async def cancel(self, seconds: float) -> set[bytes]:
        """Cancel all goals up to a time of ROS, and return those that are canceled."""
        request = CancelGoal.Request()
        stamp = request.goal_info.stamp
        stamp.sec, stamp.nanosec = divmod(int(seconds * SECOND), SECOND)
        future = self._cancels.call_async(request)

        async def done() -> bool:
            return bool(future.done())

        await eventually(done, bool)
        return {bytes(info.goal_id.uuid) for info in future.result().goals_canceling}


@asynccontextmanager
async def simulation() -> AsyncGenerator[Simulation, None]:
    place = new_url().partition("=")[2]
    with (
        anyio.fail_after(PATIENCE),
        spun_node(place, "stock") as stock,
        spun_node(place, "server", *SIMULATED) as served,
        spun_node(place, "client", *SIMULATED) as following,
    ):
        async with (
            serve(ActionServer(FIBONACCI, forever), Ros2Transport(node=served)),
            connect(Ros2Transport(node=following), FIBONACCI) as client,
        ):
            await client.wait_for_server()
            clocks = [node.get_clock() for node in (served, following)]
            yield Simulation(stock, clocks, client)


@pytest.mark.promise("CANCEL-14")
async def test_goals_are_canceled_up_to_a_time_of_the_simulation() -> None:
    async with simulation() as run:
        goals = [await run.goal_at(seconds) for seconds in (10, 11, 12)]

        assert await run.cancel(9.9) == set()
        assert await run.cancel(11.5) == {goal.goal_id for goal in goals[:2]}
        assert await run.cancel(12) == {goals[2].goal_id}  # until now


@pytest.mark.promise("CANCEL-14")
async def test_goals_are_canceled_until_now_while_the_clock_stands_still_or_has_said_nothing() -> (
    None
):
    async with simulation() as run:
        early = await run.client.send_goal(Goal(1))  # at the time 0
        goals = [await run.goal_at(7) for _ in range(3)]

        assert await run.cancel(6) == {early.goal_id}
        assert await run.cancel(7) == {goal.goal_id for goal in goals}


@pytest.mark.promise("CANCEL-14")
async def test_goals_from_before_a_jump_back_are_before_every_time_after_it() -> None:
    async with simulation() as run:
        old = await run.goal_at(100)
        new = [await run.goal_at(seconds) for seconds in (5, 6)]

        assert await run.cancel(5.5) == {old.goal_id, new[0].goal_id}
        assert await run.cancel(6) == {new[1].goal_id}


@pytest.mark.promise("CANCEL-14")
async def test_a_client_in_a_simulation_has_stamps_of_its_machine_and_cancels_by_them() -> None:
    async with simulation() as run:
        start = time.time_ns()
        goals = [await run.goal_at(seconds) for seconds in (100, 1000, 1001)]

        assert start <= goals[0].stamp < goals[1].stamp < goals[2].stamp <= time.time_ns()
        stamps = {goal.stamp for goal in goals}

        async def listed() -> set[int]:
            return {one.stamp for one in await run.client.goals()}

        assert await eventually(listed, stamps.issubset) == stamps  # the list comes by a topic
        by_stamp = await run.client.cancel_goals(before=goals[0].stamp)
        assert {one.goal_id for one in by_stamp.goals_canceling} == {goals[0].goal_id}
        in_between = (goals[1].stamp + goals[2].stamp) // 2
        until_then = await run.client.cancel_goals(before=in_between)
        assert [(one.goal_id, one.stamp) for one in until_then.goals_canceling] == [
            (goals[1].goal_id, goals[1].stamp)
        ]
        until_now = await run.client.cancel_goals(before=time.time_ns())
        assert [one.goal_id for one in until_now.goals_canceling] == [goals[2].goal_id]


async def test_a_node_of_fibactions_own_has_the_time_of_the_simulation() -> None:
    place = new_url().partition("=")[2]
    simulated = Ros2Transport(namespace=place, arguments=SIMULATED)
    with anyio.fail_after(PATIENCE), spun_node(place) as stock:
        publisher = stock.create_publisher(Clock, "/clock", 10)
        async with (
            serve(ActionServer(FIBONACCI, forever), simulated),
            connect(Ros2Transport(namespace=place), FIBONACCI) as client,  # the machine's time
        ):
            await client.wait_for_server()

            async def stamp() -> int:
                publisher.publish(Clock(clock=Time(sec=42)))
                goal = await client.send_goal(Goal(1))
                return goal.stamp

            assert await eventually(stamp, bool) == 42 * SECOND


# The rules, without ROS


class FakeClock:
    """A clock that tests set."""

    era = 0
    is_the_machines = False

    def __init__(self, now: int) -> None:
        self.time = now

    def now(self) -> int:
        return self.time


ONE, TWO, THREE = (GoalID(bytes([number]) * 16) for number in (1, 2, 3))


def test_the_stamp_of_a_goal_stays_until_the_goal_is_forgotten() -> None:
    clock: Any = FakeClock(100)
    served = ServedStamps(clock)

    assert served.to_ros(ONE, 5) == 100
    clock.time = 200
    assert [served.to_ros(ONE, 5), served.to_ros(TWO, 6)] == [100, 200]
    assert [served.from_ros(stamp) for stamp in (99, 100, 199, 200)] == [
        FIRST_STAMP,
        5,
        5,
        LAST_STAMP,
    ]
    served.forget(ONE)
    assert served.from_ros(199) == FIRST_STAMP
    served.clear()
    assert served.to_ros(TWO, 6) == 200


def test_the_machines_clock_needs_no_translation_and_is_another_era_when_it_is_exchanged() -> None:
    clock: Any = FakeClock(100)
    clock.is_the_machines = True
    served, followed = ServedStamps(clock), FollowedStamps(clock)

    assert [served.to_ros(ONE, 5), served.from_ros(7)] == [5, 7]
    assert [followed.from_ros(ONE, 5), followed.to_ros(7)] == [5, 7]
    assert followed.stamp_in_ros(ONE, 5) == 5

    clock.is_the_machines, clock.era = False, 1
    assert served.from_ros(1) == 5


def test_the_stamp_of_a_goal_in_ros_is_the_one_that_was_told_whatever_the_clock_does() -> None:
    clock: Any = FakeClock(100)
    followed = FollowedStamps(clock)
    stamp = followed.from_ros(ONE, 90)
    clock.time = 10**12
    assert followed.stamp_in_ros(ONE, stamp) == 90


def test_a_client_remembers_a_limited_number_of_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stamps, "MOST", 2)
    clock: Any = FakeClock(100)
    followed = FollowedStamps(clock)
    first = followed.from_ros(ONE, 90)
    assert followed.from_ros(ONE, 90) == first
    for goal_id in (TWO, THREE):
        followed.from_ros(goal_id, 95)
    clock.time = 10**6
    assert followed.from_ros(ONE, 90) != first


def test_a_clock_of_a_node_that_was_destroyed_can_be_closed() -> None:
    with spun_node("/t") as node:
        clock = NodeClock(node)
        assert clock.is_the_machines
    clock.close()
