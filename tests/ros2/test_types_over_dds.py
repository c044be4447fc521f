"""Types over our own DDS without their files, with stock rclpy at the other end."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import Action, TransportError, connect, serve
from fibaction.types.action import ActionInfo
from fibaction_transports.ros2 import DdsTransport
from fibaction_transports.ros2.without_ros.messages import file_types
from fibaction_transports.rtps.discovery import known_participants
from tests.ros2.ends import tells_publishers
from tests.ros2.stock.ours import TYPE, Behaviour
from tests.ros2.stock.process import PATIENCE, Peer, peer

pytestmark = pytest.mark.anyio
FILES = str(Path(__file__).parents[2] / "examples/ros2")


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no interface file be found in this process, also none that was loaded before."""
    monkeypatch.setattr(file_types, "ros_folders", lambda: iter(()))
    monkeypatch.setattr(file_types, "_program_folders", list)
    monkeypatch.setattr(file_types, "known_action", lambda type_name: None)


@pytest.fixture
async def client(alone: str) -> AsyncGenerator[Peer, None]:
    async with peer("client", ROS_DOMAIN_ID=alone) as found:
        yield found


async def found(connection: Any, name: str) -> ActionInfo:
    while True:
        for info in await connection.actions():
            if info.name == name:
                assert isinstance(info, ActionInfo)
                return info


async def test_a_robot_of_kilted_tells_all_of_its_types_and_takes_goals(
    alone: str, no_files: None
) -> None:
    if not tells_publishers():
        return  # Fast DDS of Jazzy answers no questions about types
    with anyio.fail_after(2 * PATIENCE):
        async with (
            peer("tutorial_server", ROS_DOMAIN_ID=alone),
            connect(DdsTransport(domain_id=int(alone), discovery_timeout=PATIENCE)) as connection,
        ):
            info = await found(connection, "tutorial")
            while not info.goal:  # an answer may take longer on a busy machine
                info = await found(connection, "tutorial")
            client = connection.client(Action.untyped(info))
            await client.wait_for_server()
            result = await client.call({"order": 5})
            assert result == {"sequence": [0, 1, 1, 2, 3, 5]}


async def test_a_robot_of_rclpy_tells_the_type_of_its_feedback(
    alone: str, no_files: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_participants, "ANSWERS_TYPES", 1 << 31)  # which none has
    with anyio.fail_after(2 * PATIENCE):
        async with (
            peer("tutorial_server", ROS_DOMAIN_ID=alone),
            connect(DdsTransport(domain_id=int(alone), discovery_timeout=PATIENCE)) as connection,
            connect(
                DdsTransport(domain_id=int(alone), search=[FILES]),
                Behaviour().server("tutorial").action,
            ) as knowing,
        ):
            info = await found(connection, "tutorial")
            assert info.type_name == TYPE
            assert (info.goal, info.result) == ({}, {})
            assert "partial_sequence" in str(info.feedback)
            client = connection.client(Action.untyped(info))
            await client.wait_for_server()
            await knowing.wait_for_server()
            # So long that some of its feedback is still to come.
            goal = await knowing.send_goal(knowing.action.goal.type(40))
            followed = await client.attach(goal.goal_id)
            async for feedback in followed.feedback:
                assert feedback["partial_sequence"][:3] == [0, 1, 1]
                break
            with pytest.raises(TransportError, match="are not known here: put arduinobot_msgs"):
                await client.send_goal({"order": 3})


async def test_a_stock_client_asks_for_our_types_and_is_not_disturbed_by_our_hashes(
    alone: str, client: Peer
) -> None:
    transport = DdsTransport("our_node", domain_id=int(alone), search=[FILES])
    with anyio.fail_after(2 * PATIENCE):
        async with serve(Behaviour().server("ours"), transport):
            sent = await client.ask("send", action="ours", order=5)
            assert sent["accepted"]
            (end,) = await client.ask("publisher_hashes", topic="/ours/_action/feedback")
            assert end.startswith("RIHS01_604ef495")
            described = await client.ask(
                "type_description",
                node="/our_node",
                type_name=f"{TYPE}_FeedbackMessage",
                type_hash=end,
            )
            assert described["successful"], described
            assert described["type_name"] == f"{TYPE}_FeedbackMessage"
            assert described["types"] == [
                f"{TYPE}_Feedback",
                "unique_identifier_msgs/msg/UUID",
            ]
