"""MCP over stdin and stdout of this process, which are pipes here."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import anyio
import pytest

from fibaction import InvalidURL, TransportError, serve
from fibaction.border.urls import transport_for
from fibaction_transports.mcp import McpBridge, McpStdioTransport, mcp_transport
from tests.support.processes import PATIENCE
from tests.transports.mcp.robot import UNASKED, Robot

pytestmark = pytest.mark.asyncio


class Pipes:
    """The other ends of stdin and stdout."""

    def __init__(self, write: int, read: int) -> None:
        self.write = os.fdopen(write, "wb", buffering=0)
        self._read = os.fdopen(read, "rb")

    def say(self, method: str, **params: Any) -> None:
        """Send a request."""
        text = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        self.write.write(json.dumps(text).encode() + b"\n")

    async def answer(self) -> Any:
        """Return the next answer."""
        with anyio.fail_after(PATIENCE):
            line = await anyio.to_thread.run_sync(self._read.readline)
        return json.loads(line)

    def close(self) -> None:
        """Close both."""
        self.write.close()
        self._read.close()


@contextmanager
def piped(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pipes]:
    """Let stdin and stdout be pipes. Not a fixture: pytest sets both anew before the test."""
    reads, other_write = os.pipe()
    other_read, writes = os.pipe()
    pipes = Pipes(other_write, other_read)
    with (
        io.TextIOWrapper(os.fdopen(reads, "rb")) as stdin,
        io.TextIOWrapper(os.fdopen(writes, "wb")) as stdout,
        monkeypatch.context() as patch,
    ):
        patch.setattr(sys, "stdin", stdin)
        patch.setattr(sys, "stdout", stdout)
        yield pipes
        pipes.close()


HELLO: dict[str, Any] = {
    "protocolVersion": "2025-11-25",
    "capabilities": {},
    "clientInfo": {"name": "test", "version": "1"},
}


async def test_a_client_is_served_until_it_closes_stdin(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot()
    with piped(monkeypatch) as pipes, anyio.fail_after(PATIENCE):
        async with serve(robot.drive, robot.here), McpBridge(robot.here, UNASKED) as bridge:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(bridge.run_stdio)
                pipes.say("initialize", **HELLO)
                answer = await pipes.answer()
                assert answer["result"]["capabilities"]["tools"] == {"listChanged": True}
                pipes.write.write(b"\xff this is not JSON\n")
                pipes.say("tools/call", name="arm-drive", arguments={"meters": 100})
                await robot.waits.wait()
                pipes.write.close()
            # The end of stdin has ended the bridge, and the goal that a tool waited for.
            await robot.stopped.wait()


@pytest.mark.parametrize("half", ["\ud800", "\udc00 and \ud83d\ude00"])
async def test_a_message_with_half_a_character_is_answered(
    monkeypatch: pytest.MonkeyPatch, half: str
) -> None:
    robot = Robot()
    with piped(monkeypatch) as pipes, anyio.fail_after(PATIENCE):
        async with serve(robot.drive, robot.here), McpBridge(robot.here, UNASKED) as bridge:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(bridge.run_stdio)
                pipes.say("initialize", **HELLO)
                await pipes.answer()
                pipes.write.write(b'{"broken": "\\ud800\n')
                pipes.say("tools/call", name="arm-drive", arguments={"meters": half})
                assert "meters" in (await pipes.answer())["result"]["content"][0]["text"]
                pipes.write.close()


async def test_a_bridge_that_waits_for_a_line_can_be_canceled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = Robot()
    with piped(monkeypatch) as pipes, anyio.fail_after(PATIENCE):
        async with McpBridge(robot.here) as bridge, anyio.create_task_group() as tasks:
            tasks.start_soon(bridge.run_stdio)
            pipes.say("initialize", **HELLO)
            await pipes.answer()
            tasks.cancel_scope.cancel()
        pipes.write.close()  # for the thread that still waits


async def test_it_has_no_clients_but_language_models() -> None:
    with pytest.raises(TransportError, match=r"clients of mcp\+stdio:// are language models"):
        McpStdioTransport().connect()


async def test_a_server_is_served_over_them_by_a_url(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot()
    transport = transport_for("mcp+stdio://?unasked=*")
    assert isinstance(transport, McpStdioTransport)
    with piped(monkeypatch) as pipes, anyio.fail_after(PATIENCE):
        async with serve(robot.drive, transport) as (url,):
            assert url == "mcp+stdio://"
            pipes.say("initialize", **HELLO)
            await pipes.answer()
            pipes.say("tools/call", name="arm-drive", arguments={"meters": 2})
            assert (await pipes.answer())["result"]["structuredContent"]["result"] == {"at": 2}
            pipes.write.close()
            await transport.wait_end()


async def test_the_block_ends_while_it_waits_for_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with piped(monkeypatch) as pipes, anyio.fail_after(PATIENCE):
        async with serve(Robot().drive, "mcp+stdio://"):
            pipes.say("initialize", **HELLO)
            await pipes.answer()
        pipes.write.close()


async def test_only_one_serves_over_them(monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(*_: Any, **__: Any) -> Any:
        raise RuntimeError("another one has claimed it")

    monkeypatch.setattr(mcp_transport, "stdio_streams", taken)
    with pytest.raises(TransportError, match="is served already by this process"):
        async with serve(Robot().drive, "mcp+stdio://"):
            pass


async def test_there_is_no_address() -> None:
    with pytest.raises(InvalidURL, match="no host and no path"):
        transport_for("mcp+stdio://robot")
