"""`mcp`: as a process that a client of the SDK starts, over HTTP, and piece by piece here."""

from __future__ import annotations

import io
import json
import re
import signal
import sys
import urllib.error
import urllib.request
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters
from mcp_types import CallToolResult, ElicitResult, TextContent

from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import serve_mcp
from fibaction.cli.verbs.serve_mcp import named_servers, url_of_http
from tests.cli.conftest import Invoke, Start, command, environment
from tests.support.processes import PATIENCE, ended, lines_until

OWN = ["send_goal", "goal_status", "cancel_goal"]
LONG = 50.0
"""Seconds for a test with several processes, one after another."""
ADDRESS = re.compile(r"over (http\S+) with the token (\S+), Ctrl-C stops it")


def client(*arguments: str, answer: Any = None, mode: Any = "auto") -> Client:
    """A client that starts the command, and whose user always answers so."""

    async def ask(context: Any, params: Any) -> ElicitResult:
        return ElicitResult(action=answer, content={})

    python, *rest = command("mcp", *arguments)
    process = StdioServerParameters(command=python, args=rest, env=environment(None))
    return Client(process, mode=mode, elicitation_callback=ask if answer else None)


def text_of(result: CallToolResult) -> str:
    (content,) = result.content
    assert isinstance(content, TextContent)
    return content.text


# Over stdio


@pytest.mark.asyncio
@pytest.mark.parametrize("mode", ["legacy", "auto"])
async def test_a_client_starts_it_and_its_user_is_asked(tcp: str, mode: Any) -> None:
    with anyio.fail_after(LONG):
        async with client(tcp, answer="accept", mode=mode) as made:
            tools = [tool.name for tool in (await made.list_tools()).tools]
            assert tools[-3:] == OWN
            assert "arm-pick" in tools
            result = await made.call_tool("fibonacci", {"order": 3})
            data: Any = result.structured_content
            assert data["result"] == {"sequence": [0, 1, 1, 2]}
            rejected = await made.call_tool("arm-pick", {"object_name": "sun"})
            assert rejected.is_error
            assert "the sun is too hot" in text_of(rejected)


@pytest.mark.asyncio
async def test_a_client_that_cannot_ask_sends_what_the_command_line_permits(tcp: str) -> None:
    arguments = (tcp, "--allow", "fibonacci", "--allow", "wait", "--unasked", "fibonacci")
    with anyio.fail_after(LONG):
        async with client(*arguments) as made:
            assert [tool.name for tool in (await made.list_tools()).tools] == [
                "fibonacci",
                "wait",
                *OWN,
            ]
            assert "must agree" in text_of(await made.call_tool("wait", {}))
            done = await made.call_tool("fibonacci", {"order": 3})
            assert not done.is_error


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_a_signal_ends_it_while_it_waits_for_a_line(
    started: Start, tcp: str, number: signal.Signals
) -> None:
    process = started("mcp", tcp)
    lines_until("serving the tools .* over stdin and stdout", process, errors=True)
    process.send_signal(number)
    assert process.wait(PATIENCE) == 0
    assert process.stdout is not None
    assert process.stdout.read() == ""


def test_the_end_of_stdin_ends_it_and_nothing_else_is_on_stdout(
    invoke: Invoke, nobody: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO()))
    result = invoke("mcp", nobody)
    assert result.exit_code == ExitCode.SUCCEEDED
    assert result.stdout == ""
    assert "serving the tools send_goal, goal_status, cancel_goal over" in result.stderr
    assert "; the server cannot be reached yet: no server listens at" in result.stderr


# Over HTTP


def status_of(url: str, token: str = "") -> int:
    """Return the status of the answer to a first request."""
    hello = {"protocolVersion": "2025-11-25", "capabilities": {}}
    hello["clientInfo"] = {"name": "test", "version": "1"}
    body = json.dumps({"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": hello})
    headers = {
        "Content-Type": "application/json",
        "Accept": "application/json, text/event-stream",
        **({"Authorization": f"Bearer {token}"} if token else {}),
    }
    request = urllib.request.Request(url, body.encode(), headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code


def test_over_http_a_new_token_is_printed(started: Start, tcp: str) -> None:
    process = started("mcp", tcp, "--http", ":0")
    found = ADDRESS.search(lines_until("serving", process)[-1])
    assert found is not None
    url, token = found.groups()
    assert url.startswith("http://127.0.0.1:")
    assert len(token) >= 16
    assert (status_of(url), status_of(url, "wrong"), status_of(url, token)) == (401, 401, 200)
    process.send_signal(SIGTERM)
    assert ended(process).code == 0


def test_over_http_the_token_may_come_from_the_environment(
    invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []

    def say_and_stop(text: str) -> None:
        told.append(text)
        signal.raise_signal(SIGTERM)

    monkeypatch.setattr(serve_mcp, "say", say_and_stop)
    result = invoke("mcp", tcp, "--http", ":0", env={"FIBACTION_MCP_TOKEN": "s3cret"})
    assert result.exit_code == 0
    result = invoke("mcp", tcp, "--http", "127.0.0.1:0")
    assert result.exit_code == 0
    first, second = told
    assert "with the token in FIBACTION_MCP_TOKEN, Ctrl-C" in first
    assert "s3cret" not in first
    assert ADDRESS.search(second)


def test_a_token_that_cannot_be_one_is_one_sentence(invoke: Invoke, tcp: str) -> None:
    result = invoke("mcp", tcp, "--http", ":0", env={"FIBACTION_MCP_TOKEN": "x" * 5000})
    assert result.exit_code == ExitCode.USAGE
    assert result.stderr.startswith("Error: FIBACTION_MCP_TOKEN: token has")


# The arguments


def test_a_server_may_have_a_name() -> None:
    assert named_servers(["tcp://h:1?token=a=b"]) == {"": "tcp://h:1?token=a=b"}
    assert named_servers(["left=tcp://h:1?token=a=b", "right=nats+tls://h/x"]) == {
        "left": "tcp://h:1?token=a=b",
        "right": "nats+tls://h/x",
    }


@pytest.mark.parametrize(
    ("address", "has_tls", "url"),
    [
        (":8090", False, "mcp+http://127.0.0.1:8090"),
        ("0.0.0.0:80", True, "mcp+https://0.0.0.0:80"),
        ("[::1]:0", False, "mcp+http://[::1]:0"),
    ],
)
def test_an_address_for_http_has_a_port(address: str, has_tls: bool, url: str) -> None:
    assert url_of_http(address, has_tls=has_tls) == url


@pytest.mark.parametrize("address", ["", "8090", ":", ":x", ":65536", "h:²"])
def test_an_address_for_http_without_a_port_is_an_error(address: str) -> None:
    with pytest.raises(ValueError, match="--http is like"):
        url_of_http(address, has_tls=False)
