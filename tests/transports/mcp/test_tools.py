"""Goals by tools, in both protocols, with the client of the SDK in memory."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from mcp_types import ToolAnnotations

from fibaction import Action, GoalStatus, serve
from fibaction.testing import ScriptedServer
from fibaction_transports.mcp import AgentPolicy, McpBridge, answers
from tests.support.ports import free_port
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import Drive
from tests.transports.mcp.robot import (
    MODES,
    UNASKED,
    Mode,
    Robot,
    robot_and_talk,
    sent_by_others,
    talk,
    text_of,
)

pytestmark = pytest.mark.asyncio
both = pytest.mark.parametrize("mode", MODES)


@both
async def test_each_action_is_a_tool_with_the_schema_of_its_goals(mode: Mode) -> None:
    async with robot_and_talk(mode) as (_, made):
        tools = {tool.name: tool for tool in (await made.client.list_tools()).tools}
        own = ["send_goal", "goal_status", "cancel_goal"]
        assert list(tools) == ["arm-drive", "count", *own] == made.bridge.tools
        drive = tools["arm-drive"]
        assert drive.title == "arm/drive"
        assert drive.description == (
            "Send a goal to the action arm/drive, of the type a/action/Drive, and wait for its"
            " result. Drive straight on. The user is asked before the goal is sent."
        )
        assert drive.input_schema["required"] == ["meters"]
        assert list(drive.input_schema["properties"]) == ["meters", "speed"]
        assert tools["count"].input_schema["properties"] == {"goal": {"type": "integer"}}
        assert tools["send_goal"].input_schema["properties"]["tool"]["enum"] == [
            "arm-drive",
            "count",
        ]
        for name in ("arm-drive", "count", "send_goal", "cancel_goal"):
            annotations = tools[name].annotations
            assert isinstance(annotations, ToolAnnotations)
            assert annotations.read_only_hint is False
            assert annotations.destructive_hint is True
        assert made.client.instructions is not None
        assert "A goal may move something" in made.client.instructions
        assert made.client.server_capabilities.tools is not None
        assert made.client.server_capabilities.tools.list_changed is True


@both
async def test_a_tool_sends_a_goal_and_answers_with_its_result(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        result = await made.call("arm-drive", meters=3)
        assert not result.is_error
        data: Any = result.structured_content
        assert data | {"goal_id": ""} == {
            "goal_id": "",
            "action": "arm-drive",
            "status": "SUCCEEDED",
            "result": {"at": 3},
        }
        assert text_of(result).endswith('"status":"SUCCEEDED","result":{"at":3}}')
        assert robot.sent == [Drive(3, 0.5)]
        assert made.progress == [(1, '{"meters":1}')]
        assert (await made.data("count", goal=2))["result"] == "xx"


@both
async def test_the_pieces_of_a_text_are_all_reported(mode: Mode) -> None:
    action = Action("answer", goal=None, feedback=str, result=int)
    pieces = [f"word {number} " for number in range(50)]
    url = f"tcp://127.0.0.1:{free_port()}"
    async with (
        ScriptedServer(action, [*pieces, 50]) as server,
        serve(server, url),
        McpBridge(url, UNASKED) as bridge,
        talk(bridge, mode) as made,
    ):
        assert (await made.data("answer"))["result"] == 50
    assert "".join(text or "" for _, text in made.progress) == "".join(pieces)


@both
async def test_what_went_wrong_is_an_error_that_says_why(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        text = await made.error("arm-drive", meters=-1)
        assert text == "The goal was rejected, and nothing was done: it cannot drive backwards"
        assert (await made.error("arm-drive", meters=-9)).endswith("the server gave no reason")
        text = await made.error("arm-drive", meters=13)
        sentence, data = text.split("\n")
        assert sentence == "The goal was aborted: there is a wall"
        assert data.endswith('"status":"ABORTED","result":{"at":12},"reason":"there is a wall"}')
        text = await made.error("arm-drive", meters="far", speed="fast", color="red")
        assert text.startswith("The goal was not sent: ")
        assert "goal.meters" in text
        assert "color" in text
        assert await made.error("count", goal=1, other=2) == (
            "The goal was not sent: the input has the field 'goal' and no other."
        )
        assert "the field 'goal'" in await made.error("count")
        assert await made.error("fly") == (
            "There is no tool 'fly' now; there are arm-drive, count."
        )
        assert robot.sent == [Drive(13)]


@both
async def test_the_goal_of_a_client_that_goes_is_canceled(mode: Mode) -> None:
    robot = Robot()
    async with (
        serve((robot.drive, robot.count), robot.here),
        McpBridge(robot.here, UNASKED) as bridge,
        anyio.create_task_group() as tasks,
    ):
        with anyio.fail_after(PATIENCE):

            async def call(*, task_status: anyio.abc.TaskStatus[anyio.CancelScope]) -> None:
                with anyio.CancelScope() as scope:
                    task_status.started(scope)
                    async with talk(bridge, mode) as made:
                        await made.call("arm-drive", meters=100)

            scope = await tasks.start(call)
            await robot.waits.wait()
            scope.cancel()
            await robot.stopped.wait()


@both
async def test_a_goal_that_outlasts_the_patience_goes_on_and_can_be_waited_for(mode: Mode) -> None:
    policy = AgentPolicy(unasked=("*",), patience=0.05)
    async with robot_and_talk(mode, policy) as (robot, made):
        result = await made.call("arm-drive", meters=100)
        assert not result.is_error
        assert text_of(result).startswith("The goal has not ended yet. To wait for it,")
        data: Any = result.structured_content
        assert data["status"] == "EXECUTING"
        assert data["feedback"] == {"meters": 1}
        goal_id = data["goal_id"]
        again = await made.data("goal_status", goal_id=goal_id, wait=0.01)
        assert again == data
        done = await made.data("cancel_goal", goal_id=goal_id, wait=0.05)
        assert done["status"] == "CANCELED"
        assert robot.stopped.is_set()


@both
async def test_a_goal_is_sent_followed_and_canceled_by_tools_of_their_own(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        assert sent["status"] in ("ACCEPTED", "EXECUTING")
        goal_id = sent["goal_id"]
        await robot.waits.wait()
        canceled = await made.call("cancel_goal", goal_id=goal_id)
        assert not canceled.is_error
        assert text_of(canceled).startswith("The goal was canceled: it has braked\n")
        data: Any = canceled.structured_content
        assert data["result"] == {"at": 1}
        again = await made.data("cancel_goal", goal_id=goal_id)
        assert again == data
        # For the tool that tells how it is, a goal that did not succeed is an error.
        assert "was canceled" in await made.error("goal_status", goal_id=goal_id)

        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 3})
        ended = await made.data("goal_status", goal_id=sent["goal_id"], wait=10)
        assert ended["status"] == "SUCCEEDED"

        assert "no tool 'fly'" in await made.error("send_goal", tool="fly", goal={})
        assert "goal.meters" in await made.error("send_goal", tool="arm-drive", goal={})
        text = await made.error("send_goal", goal={})
        assert text.startswith("Nothing was done: ")
        assert "tool" in text


@both
async def test_a_cancel_that_is_rejected_says_why(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        await robot.waits.wait()
        robot.is_stubborn = True
        assert await made.error("cancel_goal", goal_id=sent["goal_id"]) == (
            "The server rejects the cancel, and the goal continues: it is on a slope"
        )
        assert not robot.stopped.is_set()


@both
async def test_goals_of_others_are_listed_and_followed(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        await (await sent_by_others(robot, 3)).outcome()
        other = await sent_by_others(robot, 100)
        await robot.waits.wait()
        overview = await made.data("goal_status")
        assert overview["servers"] == [{"reachable": True}]
        drive, count = overview["actions"]
        assert (drive["tool"], drive["action"]) == ("arm-drive", "arm/drive")
        assert drive["goal_count"] == 2
        goal, ended = drive["goals"]  # the newest first
        assert ended["status"] == "SUCCEEDED"
        assert goal["goal_id"] == str(other.goal_id)
        assert goal["status"] == "EXECUTING"
        assert goal["accepted"].startswith("20")
        assert count["goals"] == []
        told = await made.data("goal_status", goal_id=str(other.goal_id))
        assert told["feedback"] == {"meters": 1}
        done = await made.data("cancel_goal", goal_id=str(other.goal_id))
        assert done["status"] == "CANCELED"
        assert (await other.outcome()).status is GoalStatus.CANCELED


@both
async def test_a_goal_that_no_server_knows_is_an_error(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (_, made):
        text = await made.error("goal_status", goal_id="0" * 31 + "1")
        assert text.startswith(f"There is no goal {'0' * 31}1: it was never accepted")
        text = await made.error("goal_status", goal_id="mine")
        assert text == "a goal ID has 32 hexadecimal digits, not 'mine'."
        assert "wait" in await made.error("goal_status", goal_id="0" * 32, wait=-1)


@both
async def test_a_bridge_that_is_read_only_shows_goals_and_sends_none(mode: Mode) -> None:
    policy = AgentPolicy(read_only=True, unasked=("*",))
    async with robot_and_talk(mode, policy) as (robot, made):
        assert await made.tools() == ["goal_status"]
        assert made.client.instructions is not None
        assert "send none" in made.client.instructions
        other = await sent_by_others(robot, 100)
        await robot.waits.wait()
        goal_id = str(other.goal_id)
        assert (await made.data("goal_status", goal_id=goal_id))["status"] == "EXECUTING"
        assert "is read-only" in await made.error("arm-drive", meters=1)
        assert "is read-only" in await made.error("send_goal", tool="arm-drive", goal={"meters": 1})
        assert "is read-only" in await made.error("cancel_goal", goal_id=goal_id)
        assert robot.sent == [Drive(100)]
        assert not robot.stopped.is_set()
        await other.cancel()


@both
async def test_what_is_not_allowed_does_not_exist(mode: Mode) -> None:
    policy = AgentPolicy(allow=("count",), unasked=("*",))
    async with robot_and_talk(mode, policy) as (robot, made):
        assert await made.tools() == ["count", "send_goal", "goal_status", "cancel_goal"]
        assert "no tool 'arm-drive'" in await made.error("arm-drive", meters=1)
        other = await sent_by_others(robot, 100)
        await robot.waits.wait()
        (action,) = (await made.data("goal_status"))["actions"]
        assert action["tool"] == "count"
        assert "There is no goal" in await made.error("goal_status", goal_id=str(other.goal_id))
        assert "There is no goal" in await made.error("cancel_goal", goal_id=str(other.goal_id))
        assert robot.sent == [Drive(100)]
        await other.cancel()


async def test_a_result_that_is_too_long_for_a_model_is_cut(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers, "LONGEST_ANSWER", 100)
    async with robot_and_talk("auto", UNASKED) as (_, made):
        result = await made.call("count", goal=1000)
        assert set(result.structured_content or {}) == {"goal_id", "action", "status"}
        assert text_of(result).startswith("The first 100 of 10")
        assert len(text_of(result)) < 200


async def test_what_json_cannot_express_is_said() -> None:
    assert "cannot be written as JSON" in answers.json_text({"a": object()})
    assert "error" in answers.message_in(b"\xc1")
