"""`fibaction bridge dds://`: a gateway without ROS, to Cyclone DDS and to nodes of ours.

`tests/ros2/test_bridge.py` has nodes of rclpy on both sides.
"""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest

from fibaction import GoalStatus, connect, serve
from tests.support.bridging import bridge
from tests.support.fibonacci import Goal, Result
from tests.transports.cyclone import dds_end
from tests.transports.cyclone.dds_end import NINE, cyclone_client, cyclone_server, new_name
from tests.transports.cyclone.partner import needs_cyclone

pytestmark = [pytest.mark.anyio, needs_cyclone]

SUCCEEDED = {"status": GoalStatus.SUCCEEDED, "sequence": NINE}


async def test_robots_of_both_forms_are_reached_by_clients_of_both_forms() -> None:
    near, ours, theirs = f"n{uuid.uuid4().hex}", new_name(), new_name()
    async with (
        serve(dds_end.server(ours), "dds://"),
        cyclone_server(theirs),
        bridge("dds://gateway", "dds://", ours, theirs, "--into", f"/{near}"),
    ):
        for name in (f"{near}/{ours}", f"{near}/{theirs}"):
            async with dds_end.client(name) as client, cyclone_client(name) as cyclone:
                assert await client.call(Goal(9)) == Result(NINE)
                sent = await cyclone.ask("send", order=9)
                assert await cyclone.ask("result", goal=sent["goal"]) == SUCCEEDED
                assert len(await cyclone.ask("feedback", goal=sent["goal"], count=8)) == 8


async def test_a_robot_on_cyclone_is_reached_over_a_socket(tmp_path: Path) -> None:
    name, url = new_name(), f"unix://{tmp_path}/socket"
    async with (
        cyclone_server(name),
        bridge("dds://", url, name),
        connect(url, dds_end.action(name)) as client,
    ):
        async with client.send_goal(Goal(9)) as goal:
            assert [each.partial_sequence[-1] async for each in goal.feedback] == NINE[2:]
            assert await goal.result() == Result(NINE)
