"""An action that needs no goal is called without one, at each door, and no door asks for null."""

from __future__ import annotations

import io
from collections.abc import Awaitable, Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from uuid import uuid4

import anyio
import msgspec
import pytest
from a2a.types import Message, Part, Role

from fibaction import Action, ActionInfo, ClientConnection, action, connect, serve
from fibaction.cli.output import render
from fibaction.cli.verbs.send_goal import SendOptions, send
from fibaction.schema.template import Template
from fibaction.schema.typescript import typescript_source
from fibaction.testing import ScriptedServer
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.mcp import McpBridge
from fibaction_transports.mcp.tool_list import tool_input
from fibaction_transports.web.rosbridge.operations import Arguments
from fibaction_transports.web.rosbridge.types.action_values import GoalArguments
from tests.support.ros_domain import own_domain
from tests.transports.a2a.agent_talk import TOKEN, state_of, talking
from tests.transports.mcp.robot import UNASKED, Talk, talk
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

TYPE = "home_msgs/action/Home"
INPUT = {"type": "object", "additionalProperties": False}
GOALS = "/actions/home/goals"


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


# Each door calls the action in some ways, and returns how many these were.

Door: TypeAlias = Callable[[ScriptedServer[Any, Any, str]], Awaitable[int]]


async def by_python(server: ScriptedServer[Any, Any, str]) -> int:
    async with serve(server, "tcp://127.0.0.1:0") as (url,), connect(url) as connection:
        typed = connection.client(server.action)
        untyped = await untyped_client(connection)
        for client in (typed, untyped):
            assert await client.call() == "home"
            async with client.send_goal() as goal:
                assert await goal.result() == "home"
    return 4


async def untyped_client(connection: ClientConnection) -> Any:
    return connection.client(Action.untyped((await connection.actions())[0]))


async def by_rest(server: ScriptedServer[Any, Any, str]) -> int:
    requests: tuple[tuple[str, str, Any, dict[str, str]], ...] = (
        ("POST", GOALS, None, {}),
        ("PUT", f"{GOALS}/{'a' * 32}", None, {}),
        ("POST", GOALS, b"{}", {}),
        ("POST", GOALS, b"", {"content_type": "application/x-www-form-urlencoded"}),
    )
    async with serve(server, "http://127.0.0.1:0") as (url,):
        for method, path, body, headers in requests:
            answer = await fetch(url, method, f"{path}?wait=9", body, **headers)
            assert (answer.status, answer.json["result"]) == (201, "home")
        described = (await fetch(url, "GET", "/openapi.json")).json
    assert described["paths"][GOALS]["post"]["requestBody"]["required"] is False
    return len(requests)


async def by_rosbridge(server: ScriptedServer[Any, Any, str]) -> int:
    async with serve(server, "http://127.0.0.1:0") as (url,):
        async with connect(url.replace("http", "rosbridge")) as connection:
            typed = connection.client(server.action)
            assert await typed.call() == "home"
            untyped: Any = await untyped_client(connection)
            assert await untyped.call() == {"data": "home"}
    return 2


async def by_mcp(server: ScriptedServer[Any, Any, str]) -> int:
    async with (
        serve(server, "tcp://127.0.0.1:0") as (url,),
        McpBridge(url, UNASKED) as bridge,
        talk(bridge, "auto") as agent,
    ):
        assert (await agent.data("home"))["result"] == "home"
        result = await agent.client.call_tool("home", None)
        assert not result.is_error
        await agent.data("goal_status", **await sent_goal(agent), wait=9)
    return 3


async def sent_goal(agent: Talk) -> dict[str, str]:
    return {"goal_id": (await agent.data("send_goal", tool="home"))["goal_id"]}


async def by_a2a(server: ScriptedServer[Any, Any, str]) -> int:
    address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
    async with serve(server, address) as (url,), talking(url) as agent:
        empty = Message(message_id=str(uuid4()), role=Role.ROLE_USER, parts=[Part(text="")])
        for task in (await agent.send(made=empty), await agent.send({})):
            assert state_of(task) == "COMPLETED"
        (skill,) = agent.card.skills
        assert "It needs no goal: an empty text will do." in skill.description
    return 2


async def by_command(server: ScriptedServer[Any, Any, str]) -> int:
    async with serve(server, "tcp://127.0.0.1:0") as (url,):
        for text in ("", "{}"):
            with redirect_stdout(io.StringIO()):
                assert await send(url, "home", "", text, SendOptions()) == 0
    return 2


DOORS: dict[str, Door] = {
    "Python": by_python,
    "REST": by_rest,
    "rosbridge": by_rosbridge,
    "MCP": by_mcp,
    "A2A": by_a2a,
    "command": by_command,
}


@each_kind
@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
async def test_an_action_that_needs_no_goal_is_called_without_one(door: Door, given: Given) -> None:
    async with ScriptedServer(given.action, ["home"]) as server:
        with anyio.fail_after(30):
            calls = await door(server)
    assert server.received == [given.goal] * calls


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
