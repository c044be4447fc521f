"""An action that needs no goal is called without one, at each door, and no door asks for null."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Action, ActionInfo, action, connect, serve
from fibaction.cli.output import render
from fibaction.schema.template import Template
from fibaction.schema.typescript import typescript_source
from fibaction.testing import ScriptedServer
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.mcp import McpBridge
from fibaction_transports.mcp.tool_list import tool_input
from fibaction_transports.web.rosbridge.action_values import GoalArguments
from fibaction_transports.web.rosbridge.operations import Arguments
from tests.doors import DOORS
from tests.support.ros_domain import own_domain
from tests.transports.a2a.agent_talk import TOKEN, state_of, talking
from tests.transports.mcp.robot import UNASKED, talk
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

TYPE = "home_msgs/action/Home"
INPUT = {"type": "object", "additionalProperties": False}
GOALS = "/actions/home/goals"
TRIED = ("tcp", "rest", "rosbridge", "rosbridge client", "mcp", "a2a", "command")
"""The doors of `DOORS`; what makes a goal is the same at the others."""


class Home(msgspec.Struct):
    """Drive home."""


class Slowly(msgspec.Struct):
    """Drive home."""

    speed: float = 0.5


@dataclass
class Given:
    """A goal type, and the goal that its server gets if none is given."""

    type: Any
    goal: Any
    has_fields: bool = False

    @property
    def action(self) -> Action[Any, Any, str]:
        return Action("home", goal=self.type, feedback=int, result=str)


@action
async def home() -> str:
    """Drive home."""
    raise AssertionError("a script stands for it")


NONE, EMPTY = Given(None, None), Given(Home, Home())
FUNCTION = Given(home.goal.type, home.goal.type())
KINDS = {
    "none": NONE,
    "a struct without fields": EMPTY,
    "a function without parameters": FUNCTION,
    "a struct of defaults": Given(Slowly, Slowly(), has_fields=True),
    "a map": Given(dict[str, int], {}, has_fields=True),
    "nullable": Given(int | None, None, has_fields=True),
}
each_kind = pytest.mark.parametrize("given", KINDS.values(), ids=KINDS)
EMPTY_KINDS = {"none": NONE, "empty": EMPTY, "function": FUNCTION}
each_empty_kind = pytest.mark.parametrize("given", EMPTY_KINDS.values(), ids=EMPTY_KINDS)


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(autouse=True)
def log_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no command change the levels of the log."""
    monkeypatch.setattr(render, "log_connection", lambda: None)


@each_kind
@pytest.mark.parametrize("door", [*TRIED])
async def test_an_action_that_needs_no_goal_is_called_without_one(door: str, given: Given) -> None:
    async with ScriptedServer(given.action, ["home"]) as server:
        with anyio.fail_after(30):
            async with DOORS[door](server) as way:
                assert (await way.send()).result == "home"
    assert server.received == [given.goal]


@each_empty_kind
async def test_it_may_be_left_out_or_empty_in_any_form_of_a_door(given: Given) -> None:
    bodies: tuple[tuple[Any, dict[str, str]], ...] = (
        (None, {}),
        (b"{}", {}),
        (b"", {"content_type": "application/x-www-form-urlencoded"}),
    )
    async with ScriptedServer(given.action, ["home"]) as server:
        async with serve(server, "http://127.0.0.1:0") as (url,):
            for body, headers in bodies:
                answer = await fetch(url, "POST", f"{GOALS}?wait=9", body, **headers)
                assert (answer.status, answer.json["result"]) == (201, "home")
            described = (await fetch(url, "GET", "/openapi.json")).json
            async with McpBridge(url, UNASKED) as bridge, talk(bridge, "auto") as agent:
                assert not (await agent.client.call_tool("home", None)).is_error
                sent = await agent.data("send_goal", tool="home")
                await agent.data("goal_status", goal_id=sent["goal_id"], wait=9)
        address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
        async with serve(server, address) as (url,), talking(url) as client:
            assert state_of(await client.send({})) == "COMPLETED"
            (skill,) = client.card.skills
    assert server.received == [given.goal] * 6
    assert described["paths"][GOALS]["post"]["requestBody"]["required"] is False
    assert "It needs no goal: an empty text will do." in skill.description


@each_empty_kind
@pytest.mark.parametrize("other", [NONE, EMPTY], ids=["none", "empty"])
@pytest.mark.parametrize("scheme", ["tcp", "dds"])
async def test_no_goal_and_a_goal_without_fields_are_the_same(
    given: Given, other: Given, scheme: str, tmp_path: Path, anyio_backend: str
) -> None:
    file = tmp_path / f"{TYPE}.action"
    file.parent.mkdir(parents=True)
    file.write_text("---\nstring data\n---\nint64 data\n")

    class Text(msgspec.Struct):
        data: str = ""

    class Number(msgspec.Struct):
        data: int = 0

    served, known = (
        Action("home", goal=one.type, feedback=Number, result=Text, type_name=TYPE)
        for one in (given, other)
    )
    url = "tcp://127.0.0.1:0" if scheme == "tcp" else "dds://"
    with own_domain() as patch, anyio.fail_after(30):
        patch.setenv("FIBACTION_SEARCH", str(tmp_path))
        async with ScriptedServer(served, [Text("home")]) as server:
            async with serve(server, url) as (address,), connect(address, known) as client:
                assert await client.call(other.goal) == Text("home")
    assert server.received == [given.goal]


@each_empty_kind
def test_no_door_asks_for_null(given: Given) -> None:
    info: ActionInfo = given.action.info
    assert tool_input(info.goal).schema == INPUT
    assert Template(info.goal).value == {}
    assert "Record<string, never>;" in typescript_source([info])
    arguments: Arguments
    for arguments in ({}, [], None):
        assert GoalArguments(info).encode(arguments) == b"\x80"


@each_empty_kind
async def test_what_is_given_to_an_action_without_a_goal_is_an_error_that_names_the_field(
    given: Given,
) -> None:
    async with (
        ScriptedServer(given.action, ["home"]) as server,
        serve(server, "http://127.0.0.1:0") as (url,),
    ):
        answer, told = await fetch(url, "POST", GOALS, {"speed": 1}), 'goal has no field "speed"'
        assert (answer.status, answer.json["detail"]) == (422, f"{told}; it has no fields")
        answer = await fetch(url, "POST", GOALS, 5)
        assert "null" not in answer.json["detail"]
    assert server.received == []
