"""docs/howto/agents.md: clients with the configuration of the page reach a robot."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import httpx2
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.streamable_http import streamable_http_client

from fibaction.cli.verbs.serve_mcp import mcp_command
from fibaction.observe.followed_servers import FollowedServers
from fibaction_transports.mcp import McpHttpTransport
from tests.cli.conftest import command, environment
from tests.support.pages import blocks_of
from tests.support.processes import PATIENCE, ended, lines_until

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "howto" / "agents.md").read_text(encoding="utf-8")
CONFIGS: list[dict[str, Any]] = [
    config
    for block in blocks_of(PAGE)
    if block.language == "json"
    for servers in json.loads(block.code).values()
    for config in servers.values()
]
STARTED = [config for config in CONFIGS if "command" in config]
CONNECTED = [config for config in CONFIGS if "url" in config]
ROBOT = "tcp://127.0.0.1:7400"


@pytest.fixture(scope="module")
def robot() -> Iterator[str]:
    """The address of the robot of the page, at another port."""
    process = subprocess.Popen(
        [sys.executable, "examples/fibonacci_server.py", "--url", "tcp://127.0.0.1:0"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    (line,) = lines_until("serving", process)
    yield line.split(" at ")[1].split(",")[0]
    process.terminate()
    ended(process)


def test_the_page_has_a_configuration_for_each_way() -> None:
    assert len(STARTED) == 3
    assert len(CONNECTED) == 1


@pytest.mark.asyncio
@pytest.mark.parametrize("config", STARTED, ids=lambda config: " ".join(config["args"]))
async def test_a_client_that_starts_the_bridge_reaches_the_robot(
    config: dict[str, Any], robot: str
) -> None:
    assert config["command"].endswith("/bin/fibaction")
    python, *script = command(*(one.replace(ROBOT, robot) for one in config["args"]))
    given = {
        name: value.replace(ROBOT, robot).partition("?")[0]  # that robot asks for no token
        for name, value in config.get("env", {}).items()
    }
    process = StdioServerParameters(command=python, args=script, env=environment(None, given))
    with anyio.fail_after(PATIENCE):
        async with Client(process) as client:
            tools = [tool.name for tool in (await client.list_tools()).tools]
            assert tools == ["fibonacci", "send_goal", "goal_status", "cancel_goal"]


@pytest.mark.asyncio
@pytest.mark.parametrize("config", CONNECTED, ids=lambda config: config["url"])
async def test_a_client_over_http_reaches_the_robot(config: dict[str, Any], robot: str) -> None:
    token = config["headers"]["Authorization"].removeprefix("Bearer ")
    assert f"with the token {token}, Ctrl-C" in PAGE
    async with (
        FollowedServers({"": robot}) as group,
        McpHttpTransport(port=0, token=token).serve_group(group) as gateway,
        httpx2.AsyncClient(headers=config["headers"], trust_env=False) as http,
        Client(streamable_http_client(gateway.url, http_client=http)) as client,
    ):
        assert re.sub(r":\d+", ":8090", gateway.url) == config["url"]
        assert "fibonacci" in [tool.name for tool in (await client.list_tools()).tools]


def test_the_page_has_each_option() -> None:
    options = {option for one in mcp_command.params for option in one.opts if option[:1] == "-"}
    assert {option for option in options if option not in PAGE} == set()


def test_the_commands_of_the_page_can_be_used() -> None:
    lines = re.findall(r"^\$ fibaction mcp (.*)$", PAGE, re.MULTILINE)
    assert len(lines) == 2
    for line in lines:
        arguments = [one.strip("'") for one in line.split()]
        mcp_command.make_context("mcp", arguments).close()
