"""A2A over HTTP: what is let in, its addresses, and the answers to what is no A2A."""

from __future__ import annotations

import json
import ssl
from typing import Any

import anyio
import httpx
import pytest
from a2a.client import A2ACardResolver

from fibaction import serve
from fibaction.border.urls import transport_for
from fibaction.observe.followed_servers import FollowedServers
from fibaction.wire.settings import Limits
from fibaction.wire.transport import TlsFiles
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.a2a.a2a_http_transport import CARD_PATH
from tests.support.certificates import pems
from tests.support.loop_times import LoopTimes
from tests.support.processes import PATIENCE
from tests.transports.a2a.agent_talk import (
    GOOD,
    TOKEN,
    Robot,
    robot_and_talk,
    state_of,
    talking,
    told,
)

pytestmark = pytest.mark.asyncio
VERSION = {"A2A-Version": "1.0"}
GOAL: dict[str, Any] = {
    "message": {
        "messageId": "m",
        "role": "ROLE_USER",
        "parts": [{"data": {"meters": 3}}],
        "metadata": {"skill": "arm-drive"},
    }
}


def call(method: str, params: Any) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}


async def post(url: str, body: Any, headers: dict[str, str] | None = None) -> httpx.Response:
    """Return the answer to a body, which is JSON unless it is bytes."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    async with httpx.AsyncClient(trust_env=False, timeout=PATIENCE) as http:
        return await http.post(url, content=content, headers={**VERSION, **(headers or GOOD)})


async def test_without_the_token_the_card_tells_how_to_get_in_and_no_skills() -> None:
    async with robot_and_talk() as (_, talk):
        async with httpx.AsyncClient(trust_env=False) as http:
            card = await A2ACardResolver(http, talk.url).get_agent_card()
            assert [skill.id for skill in card.skills] == ["none"]
            assert "arm" not in str(card)
            assert card.security_schemes["token"].http_auth_security_scheme.scheme == "Bearer"
            assert card.supported_interfaces == talk.card.supported_interfaces
            where = talk.url.rstrip("/") + CARD_PATH
            assert (await http.post(where)).status_code == 401
            assert (await http.get(where, headers={"Host": "evil.example"})).status_code == 421
            assert "POST" in (await http.options(talk.url)).headers["Allow"]


@pytest.mark.parametrize(
    ("body", "code", "text"),
    [
        (b"{", -32700, "the request is not JSON: "),
        (b"[]", -32600, ""),
        (b"\xff\xfe\x00", -32700, "the request is not JSON: "),
        (b"[" * 100_000, -32700, "the request nests too deep"),
        (call("SendMessage", {"metadata": {"a": [1] * 9000}}), -32600, "16384 are the limit"),
        ([1] * 9000, -32600, "16384 are the limit"),
        (call("SendMessage", {"message": {"parts": [{}] * 100_000}}), -32602, ""),
        (b'{"jsonrpc": "2.0", "id": 1, "method": "Fly"}', -32601, "Method not found"),
        (call("SendMessage", {"message": 3}), -32602, ""),
        (call("SendMessage", {"message": {"parts": []}}), -32602, ""),
        (call("SendMessage", {"message": {"parts": [7]}}), -32602, ""),
        (call("GetTask", {}), -32602, ""),
        (call("GetTask", {"id": "x" * 1000}), -32001, "32 hexadecimal digits"),
        (call("ListTasks", {"pageSize": 101}), -32602, "between 1 and 100"),
        (call("ListTasks", {"pageToken": "next"}), -32602, "page before"),
    ],
)
async def test_what_is_no_request_is_an_error(
    body: Any, code: int, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with robot_and_talk() as (robot, talk):
        answer = (await post(talk.url, body)).json()
        assert "Traceback" not in caplog.text
        assert answer["error"]["code"] == code
        assert text in answer["error"]["message"]
        assert robot.sent == []


@pytest.mark.parametrize(
    ("skill", "part", "text"),
    [
        (7, {"data": {"meters": 3}}, "there is no skill 'that is no text' now"),
        ("arm-drive", {"data": {"meters": 3, "\ud800": 1}}, ""),
        ("arm-drive", {"data": {"meters": float("nan")}}, ""),
        ("arm-drive", {"url": "https://evil.example"}, "one part with data"),
        ("arm-drive", {"raw": "AAAA"}, "one part with data"),
    ],
)
async def test_a_part_that_is_no_goal_is_an_error(skill: Any, part: Any, text: str) -> None:
    async with robot_and_talk() as (robot, talk):
        message = {**GOAL["message"], "parts": [part], "metadata": {"skill": skill}}
        answer = (await post(talk.url, call("SendMessage", {"message": message}))).json()
        assert text in answer["error"]["message"]
        assert robot.sent == []


async def test_a_document_that_is_too_large_or_too_deep_is_an_error() -> None:
    async with robot_and_talk(limits=Limits(frame=2000)) as (robot, talk):
        large = await post(talk.url, b'"' + b"x" * 3000 + b'"')
        assert large.status_code == 413
        deep = {**GOAL["message"], "parts": [{"data": json.loads("[" * 500 + "]" * 500)}]}
        answer = (await post(talk.url, call("SendMessage", {"message": deep}))).json()
        assert "error" in answer
        assert robot.sent == []


@pytest.mark.parametrize(
    ("method", "part", "told"),
    [
        ("message/send", {"kind": "data", "data": {"meters": 3}}, '"state":"completed"'),
        ("message/send", {"kind": "text", "text": '{"meters": 3}'}, '"state":"completed"'),
        ("message/stream", {"kind": "text", "text": '{"meters": 3}'}, '"state":"completed"'),
        ("message/send", {"kind": "text", "text": "drive"}, "a text that is JSON"),
        ("message/stream", {"kind": "text", "text": "drive"}, "a text that is JSON"),
    ],
)
async def test_an_agent_of_version_0_3_is_answered_in_it(method: str, part: Any, told: str) -> None:
    message = {"kind": "message", "messageId": "m", "role": "user", "parts": [part]}
    async with robot_and_talk(allow=["arm/drive"]) as (robot, talk):
        async with httpx.AsyncClient(headers=GOOD, trust_env=False) as http:
            card = (await http.get(talk.url.rstrip("/") + CARD_PATH)).json()
            body = call(method, {"message": message})
            answer = await http.post(card["url"], json=body, timeout=PATIENCE)
        assert (card["protocolVersion"], card["preferredTransport"]) == ("0.3", "JSONRPC")
        assert told in answer.text
        assert len(robot.sent) == ("completed" in told)


async def test_a_large_document_keeps_nobody_waiting() -> None:
    data = {"meters": 3, "more": [1] * 300_000}
    message = {**GOAL["message"], "parts": [{"data": data}]}
    body = json.dumps(call("SendMessage", {"message": message})).encode()
    async with robot_and_talk() as (robot, talk), LoopTimes() as times:
        answer = (await post(talk.url, body)).json()

        assert 'no field "more"' in answer["error"]["message"]
        assert times.longest < 0.5
        assert robot.sent == []


async def test_another_version_of_the_protocol_is_an_error() -> None:
    async with robot_and_talk() as (_, talk):
        old = await post(talk.url, call("ListTasks", {}), {**GOOD, "A2A-Version": "0.3"})
        assert old.json()["error"]["code"] == -32009


async def test_it_has_the_limits_of_connections() -> None:
    async with robot_and_talk(limits=Limits(connections=1)) as (robot, talk):
        updates = talk.stream({"meters": 100}, skill="arm-drive")
        await anext(updates)
        full = await post(talk.url, call("ListTasks", {}))
        assert full.status_code == 503
        robot.go(100)
        assert [told(update) async for update in updates][-1] == "COMPLETED"


async def test_the_card_of_a_server_with_tls_has_its_address() -> None:
    files = pems()
    tls = TlsFiles(cert=files.cert, key=files.cert)
    transport = A2aHttpTransport("127.0.0.1", 0, token=TOKEN, tls=tls)
    async with serve(Robot().drive, transport) as (url,):
        assert url.startswith("https://127.0.0.1:")
        context = ssl.create_default_context(cafile=files.ca)
        async with httpx.AsyncClient(verify=context, trust_env=False) as http:
            card = await A2ACardResolver(http, url).get_agent_card()
            assert card.supported_interfaces[0].url == url


async def test_its_address_is_this_machine_unless_it_is_said() -> None:
    assert transport_for("a2a+http://").url == "a2a+http://127.0.0.1:8091"  # type: ignore[attr-defined]
    assert transport_for("a2a+https://?cert=a").url == "a2a+https://127.0.0.1:8091"  # type: ignore[attr-defined]


async def test_actions_come_and_go_behind_it() -> None:
    robot = Robot()
    async with (
        serve(robot.say, robot.here),
        FollowedServers({"": robot.here}) as group,
        A2aHttpTransport(port=0, token=TOKEN, unasked="*").serve_group(group) as gateway,
    ):
        with anyio.fail_after(PATIENCE):
            while gateway.names != ["say"]:
                await group.news.wait()
            async with serve(robot.drive, robot.here):
                while gateway.names != ["arm-drive", "say"]:
                    await group.news.wait()
                async with talking(gateway.url) as talk:
                    assert [skill.id for skill in talk.card.skills] == ["arm-drive", "say"]
                    task = await talk.send({"meters": 3}, skill="arm-drive")
                    assert state_of(task) == "COMPLETED"


async def test_it_ends_while_an_agent_reads() -> None:
    with anyio.fail_after(PATIENCE):
        async with robot_and_talk() as (robot, talk):
            updates = talk.stream({"meters": 100}, skill="arm-drive")
            await anext(updates)
    assert robot.sent
