"""MCP over HTTP, on this machine."""

from __future__ import annotations

import json
import ssl
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import httpx2
import pytest
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from mcp_types import ElicitResult, InputRequiredResult
from mcp_types.jsonrpc import HEADER_MISMATCH

from fibaction import InvalidURL, TransportError, connect, serve
from fibaction.border.urls import transport_for
from fibaction.observe.followed_servers import FollowedServers
from fibaction.wire.transport import TlsFiles
from fibaction_transports.mcp import McpHttpTransport
from fibaction_transports.mcp.goal_tasks import EXTENSION
from tests.support.certificates import pems
from tests.support.loop_times import LoopTimes
from tests.support.processes import PATIENCE
from tests.transports.driving_robot import DRIVE, Drive
from tests.transports.mcp.robot import MODES, YES, Mode, Robot, Rounds, Talk

pytestmark = pytest.mark.asyncio
both = pytest.mark.parametrize("mode", MODES)
HELLO: dict[str, Any] = {
    "protocolVersion": "2025-11-25",
    "capabilities": {},
    "clientInfo": {"name": "test", "version": "1"},
}
TOKEN = "tW4x9c-tW4x9c"
GOOD = {"Authorization": f"Bearer {TOKEN}"}


@asynccontextmanager
async def served(
    host: str = "127.0.0.1", **settings: Any
) -> AsyncGenerator[tuple[Robot, str], None]:
    robot = Robot()
    transport = McpHttpTransport(host, 0, token=TOKEN, **settings)
    async with serve((robot.drive, robot.count), transport) as (url,):
        yield robot, url


@asynccontextmanager
async def talking(url: str, mode: Mode, token: str = TOKEN) -> AsyncGenerator[Talk, None]:
    made = Talk()

    async def yes(context: Any, params: Any) -> ElicitResult:
        made.asked.append(params.message)
        return ElicitResult(action="accept", content={})

    async def note(message: Any) -> None:
        if type(message).__name__ == "ToolListChangedNotification":
            made.told.set()

    headers = {"Authorization": f"Bearer {token}"}
    async with httpx2.AsyncClient(headers=headers, trust_env=False) as http:
        made.client = Client(
            streamable_http_client(url, http_client=http),
            mode=mode,
            elicitation_callback=yes,
            message_handler=note,
        )
        async with made.client:
            yield made


@both
async def test_the_user_is_asked_and_the_goal_runs(mode: Mode) -> None:
    async with served() as (robot, url), talking(url, mode) as made:
        assert url.endswith("/mcp")
        assert (await made.data("arm-drive", meters=3))["result"] == {"at": 3}
        assert made.progress == [(1, '{"meters":1}')]
        assert len(made.asked) == 1
        assert robot.sent == [Drive(3)]


async def test_the_answer_of_another_client_does_not_send_a_goal() -> None:
    other = "b-b-b-b-b-b-b-b"
    async with (
        served(tokens={other: "bob"}) as (robot, url),
        talking(url, "auto") as alice,
        talking(url, "auto", other) as bob,
    ):
        state = await Rounds(alice).ask(3)

        again = await Rounds(bob).call(3, input_responses=YES, request_state=state)

        assert isinstance(again, InputRequiredResult)
        assert robot.sent == []


@both
async def test_a_user_is_asked_before_the_goal_of_another_client_is_canceled(mode: Mode) -> None:
    other = "b-b-b-b-b-b-b-b"
    async with (
        served(tokens={other: "bob"}) as (robot, url),
        talking(url, mode) as alice,
        talking(url, mode, other) as bob,
    ):
        sent = await alice.data("send_goal", tool="arm-drive", goal={"meters": 100})
        await robot.waits.wait()

        await bob.data("cancel_goal", goal_id=sent["goal_id"])

        assert [question[:15] for question in bob.asked] == ["Cancel the goal"]


def modern(
    method: str, named: str, params: dict[str, Any], **capabilities: Any
) -> tuple[bytes, dict[str, str]]:
    """Return the body and the headers of a request of the protocol without a handshake."""
    meta = {
        "io.modelcontextprotocol/protocolVersion": "2026-07-28",
        "io.modelcontextprotocol/clientInfo": {"name": "test", "version": "1"},
        "io.modelcontextprotocol/clientCapabilities": capabilities,
    }
    request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": {**params, "_meta": meta}}
    return json.dumps(request).encode(), {
        "Accept": "application/json, text/event-stream",
        "Content-Type": "application/json",
        "MCP-Protocol-Version": "2026-07-28",
        "Mcp-Method": method,
        "Mcp-Name": named,
    }


async def test_a_large_goal_keeps_nobody_waiting() -> None:
    goal = {"meters": 3, "more": [[]] * 250_000}
    params = {"name": "arm-drive", "arguments": goal}
    body, headers = modern("tools/call", "arm-drive", params)
    async with (
        served(unasked=["*"]) as (robot, url),
        httpx2.AsyncClient(headers=GOOD, trust_env=False, timeout=PATIENCE) as http,
        LoopTimes() as times,
    ):
        answer = await http.post(url, content=body, headers=headers)

        assert 'no field \\"more\\"' in answer.text
        assert times.longest < 0.5
        assert robot.sent == []


async def test_a_header_that_names_another_task_is_an_error() -> None:
    body, headers = modern("tasks/get", "a" * 32, {"taskId": "b" * 32}, extensions={EXTENSION: {}})
    async with (
        served() as (_, url),
        httpx2.AsyncClient(headers=GOOD, trust_env=False, timeout=PATIENCE) as http,
    ):
        answer = await http.post(url, content=body, headers=headers)

        assert answer.status_code == 400
        assert answer.json()["error"]["code"] == HEADER_MISMATCH


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (b"[" + b"[]," * 300_000 + b"[]]", "beside its goal; 16384 are the limit"),
        (b"[" * 100_000, "the request nests too deep"),
        (b"garbage", "the request is not JSON: "),
        (b'{"method": "tools/call", "params": {"arguments": 3}}', "error"),
    ],
    ids=["large", "deep", "garbage", "no arguments"],
)
async def test_what_is_no_request_is_an_error_without_a_traceback(
    body: bytes, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with served() as (robot, url), httpx2.AsyncClient(headers=GOOD, trust_env=False) as http:
        answer = await http.post(url, content=body, headers={"Content-Type": "application/json"})

        assert answer.status_code in (400, 406)
        assert text in answer.text
        assert "Traceback" not in caplog.text
        assert robot.sent == []


@both
async def test_a_call_that_the_client_cancels_cancels_its_goal(mode: Mode) -> None:
    async with served(unasked=["*"]) as (robot, url), talking(url, mode) as made:
        with anyio.fail_after(PATIENCE):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(lambda: made.call("arm-drive", meters=100))
                await robot.waits.wait()
                tasks.cancel_scope.cancel()
            await robot.stopped.wait()


async def test_each_client_is_told_that_the_list_has_changed() -> None:
    robot = Robot()
    async with (
        serve(robot.count, robot.here),
        FollowedServers({"": robot.here}) as group,
        McpHttpTransport(port=0, token=TOKEN).serve_group(group) as gateway,
        talking(gateway.url, "auto") as one,
        talking(gateway.url, "auto") as two,
        one.client.listen(tools_list_changed=True),
        two.client.listen(tools_list_changed=True),
        serve(robot.drive, robot.here),
    ):
        with anyio.fail_after(PATIENCE):
            await one.told.wait()
            await two.told.wait()
        assert "arm-drive" in await two.tools()
        assert "arm-drive" in gateway.names


# What is let in


async def answer(url: str, headers: dict[str, str], **settings: Any) -> httpx2.Response:
    """Return the answer to a list of tools."""
    async with httpx2.AsyncClient(trust_env=False, **settings) as http:
        accept = {"Accept": "application/json, text/event-stream"}
        body = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": HELLO}
        return await http.post(url, headers={**accept, **headers}, json=body)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 401),
        ({"Authorization": "Bearer"}, 401),
        ({"Authorization": "Bearer wrong"}, 401),
        ({"Authorization": f"Basic {TOKEN}"}, 401),
        ({"Authorization": TOKEN}, 401),
        ({**GOOD, "Host": "evil.example"}, 421),
        ({**GOOD, "Origin": "https://evil.example"}, 403),
        ({**GOOD, "Origin": "null"}, 403),
    ],
)
async def test_a_request_without_the_token_or_of_a_foreign_page_is_refused(
    headers: dict[str, str], status: int
) -> None:
    async with served() as (_, url):
        refused = await answer(url, headers)
        assert refused.status_code == status
        assert TOKEN not in refused.text
        if status == 401:
            assert refused.headers["WWW-Authenticate"] == "Bearer"
            assert "and the token of the bridge" in refused.text
        allowed = await answer(url, GOOD)
        assert allowed.status_code == 200
        assert "server" not in allowed.headers


async def test_a_page_that_is_named_may_ask() -> None:
    page = {"Origin": "https://robot.example"}
    async with served(origins=[page["Origin"]]) as (_, url):
        async with httpx2.AsyncClient(trust_env=False) as http:
            before = await http.options(url, headers=page)
        assert before.status_code == 204
        assert "mcp-session-id" in before.headers["Access-Control-Allow-Headers"]
        got = await answer(url, GOOD | page)
        assert got.headers["Access-Control-Allow-Origin"] == page["Origin"]


async def test_a_header_that_comes_twice_does_not_count() -> None:
    async with served() as (_, url):
        async with httpx2.AsyncClient(trust_env=False) as http:
            twice = [("Authorization", f"Bearer {TOKEN}"), ("Authorization", "Bearer x")]
            assert (await http.post(url, headers=twice, json={})).status_code == 401


async def test_beyond_this_machine_it_takes_tls_or_a_word_for_it() -> None:
    with pytest.raises(TransportError, match=r"0\.0\.0\.0:0 can be reached from other machines"):
        async with served(host="0.0.0.0"):
            pass
    async with served(host="0.0.0.0", insecure=True) as (_, url):
        assert (await answer(url, GOOD)).status_code == 200
    files = pems()
    async with served(host="0.0.0.0", tls=TlsFiles(cert=files.cert, key=files.cert)) as (_, url):
        assert url.startswith("https://0.0.0.0:")
        here = url.replace("0.0.0.0", "127.0.0.1")
        context = ssl.create_default_context(cafile=files.ca)
        secure = await answer(here, GOOD, verify=context)
        assert secure.status_code == 200


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
async def test_this_machine_has_several_names(host: str) -> None:
    async with served(host=host) as (_, url):
        assert (await answer(url, GOOD)).status_code == 200


async def test_without_a_token_it_serves_nobody() -> None:
    with pytest.raises(TransportError, match="needs a token"):
        async with serve(Robot().drive, "mcp+http://127.0.0.1:0?token="):
            pass
    with pytest.raises(ValueError, match="token has 5000 bytes"):
        McpHttpTransport(token="x" * 5000)


async def test_the_settings_in_a_url_are_those_of_the_constructor() -> None:
    robot = Robot()
    url = f"mcp+http://localhost:0?token={TOKEN}&allow=arm/*,look&unasked=arm/drive&patience=3"
    async with serve((robot.drive, robot.count), url) as (where,), talking(where, "auto") as made:
        assert await made.tools() == ["arm-drive", "send_goal", "goal_status", "cancel_goal"]
        assert (await made.data("arm-drive", meters=3))["result"] == {"at": 3}
        assert made.asked == []
        (server,) = (await made.data("goal_status"))["servers"]
        assert server == {"reachable": True}


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("mcp+http://h:1?patience=0", "patience must be finite"),
        ("mcp+http://h:1?allow=", "'allow' cannot be ''"),
        ("mcp+http://h:1?read_only=yes", "'read_only' cannot be 'yes'"),
        ("mcp+http://h:1?tokens=a", "given in code"),
        ("mcp+http://h:1/path", "it has a path"),
        ("mcp+http://me@h:1", "it has a user"),
        ("mcp+http://h:65536", "[Pp]ort"),
        ("mcp+http://h:1?cert=a.pem", "no setting 'cert'"),
    ],
)
async def test_a_url_that_cannot_be_used_is_an_error(url: str, text: str) -> None:
    with pytest.raises(InvalidURL, match=text):
        transport_for(url)


async def test_its_address_is_this_machine_unless_it_is_said() -> None:
    assert transport_for("mcp+https://?cert=a").url == "mcp+https://127.0.0.1:8090"  # type: ignore[attr-defined]
    assert McpHttpTransport("::1", 5).url == "mcp+http://[::1]:5"
    with pytest.raises(ValueError, match="port must be between"):
        McpHttpTransport(port=65536)
    with pytest.raises(TypeError, match="no setting 'unask'"):
        transport_for("mcp+http://", unask=["a"])


async def test_it_has_no_clients() -> None:
    with pytest.raises(TransportError, match="are language models"):
        connect("mcp+http://127.0.0.1:1", DRIVE)._transport.connect()


async def test_it_needs_asyncio() -> None:
    async def main() -> None:
        with pytest.raises(TransportError, match="needs asyncio"):
            async with serve(Robot().drive, McpHttpTransport(token=TOKEN)):
                pass

    await anyio.to_thread.run_sync(lambda: anyio.run(main, backend="trio"))


@both
async def test_it_ends_while_a_tool_waits(mode: Mode) -> None:
    robot = Robot()
    with anyio.fail_after(PATIENCE):
        async with serve(robot.drive, robot.here), anyio.create_task_group() as tasks:
            async with (
                FollowedServers({"": robot.here}) as group,
                McpHttpTransport(port=0, token=TOKEN, unasked="*").serve_group(group) as gateway,
            ):
                url = gateway.url

                async def call() -> None:
                    with pytest.raises(BaseExceptionGroup):
                        async with talking(url, mode) as made:
                            await made.call("arm-drive", meters=100)
                            raise RuntimeError("the call has ended")

                tasks.start_soon(call)
                await robot.waits.wait()
            await robot.stopped.wait()
            tasks.cancel_scope.cancel()
