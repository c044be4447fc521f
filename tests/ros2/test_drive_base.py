"""`examples/drive_base.py`: an executor that drives a stock robot, without ROS and with it."""

from __future__ import annotations

import sys
import time
import uuid
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from signal import SIGINT, SIGKILL
from typing import Any

import anyio
import pytest
from anyio.abc import Process

from fibaction import ActionClient, GoalAborted, GoalStatus, connect
from tests.ros2.stock.process import PATIENCE, Peer, peer
from tests.ros2.stock.waiting import eventually
from tests.support.ports import free_port

# Examples are scripts beside each other.
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from drive_base import Base

pytestmark = pytest.mark.anyio

PROGRAM = Path(__file__).parents[2] / "examples" / "drive_base.py"
STOPS_WITHIN = 0.1


@asynccontextmanager
async def driven(
    scheme: str,
) -> AsyncGenerator[tuple[ActionClient[Any, float, list[float]], Peer, Process], None]:
    """Run a robot and the program; yield a client of the program, and both processes."""
    namespace, url = f"/n{uuid.uuid4().hex}", f"tcp://127.0.0.1:{free_port()}"
    command = [sys.executable, str(PROGRAM), f"{scheme}://drive_base?namespace={namespace}", url]
    async with peer("wheels", namespace) as robot, await anyio.open_process(command) as program:
        try:
            assert program.stdout is not None
            with anyio.fail_after(PATIENCE):
                await program.stdout.receive()
                async with connect(url, Base.drive) as client:
                    yield client, robot, program
        finally:
            if program.returncode is None:
                program.kill()


async def moving(robot: Peer) -> None:
    await eventually(lambda: robot.ask("tell"), lambda told: told["speed"])


async def stopped(robot: Peer) -> dict[str, float]:
    return await eventually(lambda: robot.ask("tell"), lambda told: not told["speed"])


def test_the_program_is_short() -> None:
    assert len(PROGRAM.read_text().splitlines()) <= 60


@pytest.mark.parametrize("scheme", ["dds", "ros2"])
async def test_one_executor_drives_a_stock_robot_and_a_cancel_stops_it(scheme: str) -> None:
    async with driven(scheme) as (client, robot, program):
        has_ros = "librcl" in await anyio.Path(f"/proc/{program.pid}/maps").read_text()
        assert has_ros == (scheme == "ros2")
        x, y = await client.call(0.5)
        assert (x >= 0.5, y) == (True, 2.0)
        delays = []
        for _ in range(3):  # the machine may be busy
            async with client.send_goal(100.0) as goal:
                await moving(robot)
                canceled = time.monotonic()
                await goal.cancel()
                assert (await goal.outcome()).status is GoalStatus.CANCELED
            told = await stopped(robot)
            delays.append(told["at"] - canceled)
        assert min(delays) < STOPS_WITHIN
        assert 0.015 < told["gap"] < 0.03


async def test_a_robot_that_is_lost_fails_the_goal() -> None:
    async with driven("dds") as (client, robot, _), client.send_goal(100.0) as goal:
        await moving(robot)
        robot.signal(SIGKILL)
        with pytest.raises(GoalAborted, match=r"nothing arrived on /n.*/odom in 1 s"):
            await goal.result()


async def test_ctrl_c_stops_a_robot_that_moves() -> None:
    async with driven("dds") as (client, robot, program), client.send_goal(100.0):
        await moving(robot)
        program.send_signal(SIGINT)
        await stopped(robot)
        assert await program.wait() == 0
