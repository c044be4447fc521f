"""A bridge from one middleware to another, with the types that the robot tells."""

from __future__ import annotations

import os
import uuid
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Action, ActionServer, GoalHandle, GoalStatus, connect, serve
from fibaction.types.action import ActionInfo
from tests.support.bridging import bridge
from tests.support.ports import free_port
from tests.support.ros_domain import DOMAINS

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]

PATIENCE = 60.0
TYPE = "far_msgs/action/Paint"
GOALS = 20


class Spots(msgspec.Struct):
    spots: int = 0


class Painted(msgspec.Struct):
    painted: int = 0


class Done(msgspec.Struct):
    names: list[str] = []


@pytest.fixture
def folder(tmp_path: Path) -> str:
    """A folder with the file of an action, which only its server knows."""
    path = tmp_path / f"{TYPE}.action"
    path.parent.mkdir(parents=True)
    path.write_text("int32 spots\n---\nstring[] names\n---\nint32 painted\n")
    return str(tmp_path)


async def paint(goal: GoalHandle[Spots]) -> AsyncGenerator[Painted | Done, None]:
    for number in range(goal.request.spots):
        yield Painted(number)
    if not goal.request.spots:
        await anyio.sleep_forever()
    yield Done([f"spot {number}" for number in range(goal.request.spots)])


async def found(connection: Any, name: str) -> ActionInfo:
    while True:
        for info in await connection.actions():
            if info.name.strip("/") == name.strip("/"):
                assert isinstance(info, ActionInfo)
                return info
        await anyio.sleep(0.1)


@pytest.mark.parametrize("anyio_backend", ["asyncio"])
@pytest.mark.parametrize(
    ("robot", "near"),
    [
        ("zenoh://", "dds://"),
        ("dds://", "zenoh://"),
        ("dds://", "dds://?domain_id={domain}"),
        ("zenoh://", "tcp://127.0.0.1:{port}"),
        ("ros2://?via=zenoh", "ros2://?via=dds"),
    ],
)
async def test_an_action_is_used_over_another_middleware_without_its_files(
    robot: str, near: str, folder: str
) -> None:
    space = f"/t{uuid.uuid4().hex}"
    near = near.format(port=free_port(), domain=(int(os.environ["ROS_DOMAIN_ID"]) + 1) % DOMAINS)
    action = Action("paint", goal=Spots, feedback=Painted, result=Done, type_name=TYPE)
    more = f"{'&' if '?' in robot else '?'}namespace={space}"
    with anyio.fail_after(PATIENCE):
        async with AsyncExitStack() as stack:
            enter = stack.enter_async_context
            await enter(serve(ActionServer(action, paint), f"{robot}{more}", search=[folder]))
            await enter(bridge(robot, near, f"{space}/paint"))
            connection = await enter(connect(near))
            client = connection.client(Action.untyped(await found(connection, f"{space}/paint")))

            async def one(number: int) -> None:
                spots = number % 5 + 1
                async with client.send_goal({"spots": spots}) as goal:
                    heard = [feedback["painted"] async for feedback in goal.feedback]
                    assert (await goal.result())["names"][-1] == f"spot {spots - 1}"
                assert heard == list(range(spots))

            async with anyio.create_task_group() as tasks:
                for number in range(GOALS):
                    tasks.start_soon(one, number)
            stopped = await client.send_goal({"spots": 0})
            await stopped.cancel()
            assert (await stopped.outcome()).status is GoalStatus.CANCELED
