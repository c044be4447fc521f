"""Goals that run, as resources of MCP."""

from __future__ import annotations

import json
from typing import Any

import anyio
import pytest
from mcp.shared.exceptions import MCPError
from mcp.shared.subscriptions import ResourcesListChanged, ResourceUpdated
from mcp_types import TextResourceContents
from mcp_types.jsonrpc import INVALID_PARAMS

from fibaction_transports.mcp import answers, tool_server
from tests.support.processes import PATIENCE
from tests.transports.mcp.robot import MODES, UNASKED, Mode, Talk, robot_and_talk, sent_by_others

pytestmark = pytest.mark.asyncio
both = pytest.mark.parametrize("mode", MODES)


async def read(made: Talk, uri: str) -> Any:
    """Read a resource, and return its data."""
    (content,) = (await made.client.read_resource(uri)).contents
    assert isinstance(content, TextResourceContents)
    assert (content.uri, content.mime_type) == (uri, "application/json")
    return json.loads(content.text)


@both
async def test_goals_that_run_are_listed_and_read(mode: Mode) -> None:
    async with robot_and_talk(mode, UNASKED) as (robot, made):
        assert (await made.client.list_resources()).resources == []
        goal_id = str((await sent_by_others(robot, 100)).goal_id)
        await robot.waits.wait()
        (resource,) = (await made.client.list_resources(cache_mode="bypass")).resources
        assert resource.uri == f"goal://{goal_id}"
        assert (resource.name, resource.title) == (
            f"arm-drive {goal_id[:8]}",
            "A goal of arm/drive",
        )
        assert resource.description == "EXECUTING; 1 feedback messages so far."
        data = {"goal_id": goal_id, "action": "arm-drive", "feedback_count": 1}
        data["feedback"] = {"meters": 1}
        assert await read(made, resource.uri) == data | {"status": "EXECUTING"}
        await made.call("cancel_goal", goal_id=goal_id, wait=20)
        assert (await made.client.list_resources(cache_mode="bypass")).resources == []
        ended = {"status": "CANCELED", "result": {"at": 1}, "reason": "it has braked"}
        assert await read(made, resource.uri) == data | ended
        (template,) = (await made.client.list_resource_templates()).resource_templates
        assert template.uri_template == "goal://{goal_id}"


async def test_a_goal_with_much_data_is_told_in_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "LONGEST_ANSWER", 10)
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        goal_id = str((await sent_by_others(robot, 3)).goal_id)
        data = await read(made, f"goal://{goal_id}")
        assert set(data) == {"goal_id", "action", "status"}


@pytest.mark.parametrize("uri", ["goal://7", f"goal://{'f' * 32}", f"task://{'f' * 32}"])
async def test_a_resource_that_is_not_there_is_an_error(uri: str) -> None:
    async with robot_and_talk("auto", UNASKED) as (_, made):
        with pytest.raises(MCPError, match="there is no such resource: ") as caught:
            await made.client.read_resource(uri)
        assert caught.value.error.code == INVALID_PARAMS
        assert caught.value.error.data == {"uri": uri}


async def test_the_newest_goals_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool_server, "MOST_LISTED", 1)
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        await sent_by_others(robot, 100)
        newest = str((await sent_by_others(robot, 101)).goal_id)
        (resource,) = (await made.client.list_resources()).resources
        assert resource.uri == f"goal://{newest}"


class Heard:
    """The changes that are published, up to the one that a test waits for."""

    def __init__(self) -> None:
        self.events: list[Any] = []
        self.news = anyio.Event()

    async def publish(self, event: Any) -> None:
        self.events.append(event)
        self.news.set()

    async def until(self, *events: Any) -> None:
        with anyio.fail_after(PATIENCE):
            while self.events[-len(events) :] != list(events):
                self.news = anyio.Event()
                await self.news.wait()


async def test_a_client_is_told_when_a_goal_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool_server, "PERIOD", 0.01)
    async with robot_and_talk("auto", UNASKED) as (robot, made):
        heard: Any = Heard()
        monkeypatch.setattr(made.bridge._tools._changes, "publish", heard.publish)
        sent = await made.data("send_goal", tool="arm-drive", goal={"meters": 100})
        updated = ResourceUpdated(uri=f"goal://{sent['goal_id']}")
        await robot.waits.wait()
        with anyio.fail_after(PATIENCE):
            while ResourcesListChanged() not in heard.events:
                await heard.news.wait()
        assert heard.events[0] == updated
        await made.call("cancel_goal", goal_id=sent["goal_id"], wait=20)
        await heard.until(updated, ResourcesListChanged())
        assert set(map(type, heard.events)) == {ResourceUpdated, ResourcesListChanged}
