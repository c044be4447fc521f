"""Each door of a server, as a program of a client finds it: a new door is one entry of `DOORS`."""

from __future__ import annotations

import io
import json
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import (
    AbstractAsyncContextManager,
    asynccontextmanager,
    redirect_stdout,
)
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias
from uuid import UUID

from a2a.utils.errors import A2AError
from google.protobuf.json_format import MessageToDict

from fibaction import (
    Action,
    Endpoint,
    GoalID,
    GoalRejected,
    RejectionCode,
    Transport,
    connect,
    serve,
)
from fibaction.cli.process.exit_codes import Failure
from fibaction.cli.verbs.send_goal import SendOptions, send
from fibaction_transports.a2a import A2aHttpTransport
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.mcp import McpBridge, McpHttpTransport
from tests.contract.conftest import nats_address, unix_address
from tests.support.certificates import pems
from tests.transports.a2a import agent_talk
from tests.transports.mcp import test_mcp_http
from tests.transports.mcp.robot import UNASKED, Talk, talk, text_of
from tests.transports.web.http_client import Answer, fetch
from tests.transports.web.rosbridge.clients import socket_client

TOKEN = agent_talk.TOKEN


class Told(NamedTuple):
    """What a client was told of its goal."""

    result: Any = None
    code: RejectionCode | None = None
    """The code of the rejection; None if there is none, or if the door does not tell it."""
    reason: str = ""
    is_later: bool | None = None
    """True if it was told to try again later; None if the door leaves that to the code."""


class Way(NamedTuple):
    """A door that is open."""

    url: str
    send: Callable[..., Awaitable[Told]]
    """Sends a goal, with an ID if the door takes one, or none, and waits for its end."""


Door: TypeAlias = Callable[[Endpoint], AbstractAsyncContextManager[Way]]


def by_client(new_address: Callable[[], str | Transport], scheme: str = "") -> Door:
    """Return a door for the clients of this package, whose URL may have another scheme."""

    @asynccontextmanager
    async def opened(server: Endpoint) -> AsyncGenerator[Way, None]:
        async with serve(server, new_address()) as (url,):
            if scheme:
                url = f"{scheme}://{url.partition('://')[2]}"
            async with connect(url) as connection:
                client: Any = connection.client(Action.untyped(server.info))

                async def call(*goal: Any, goal_id: GoalID | None = None) -> Told:
                    try:
                        sent = await client.send_goal(*goal, goal_id=goal_id)
                        return Told(await sent.result())
                    except GoalRejected as exc:
                        return Told(code=exc.code, reason=exc.reason)

                yield Way(url, call)

    return opened


def told_by(answer: Answer, result: Any) -> Told:
    """Return what an answer of REST tells."""
    if answer.status < 400:
        return Told(result)
    problem = answer.json
    code = RejectionCode[problem["code"]] if "code" in problem else None
    return Told(None, code, problem["detail"], "retry-after" in answer.headers)


@asynccontextmanager
async def rest(server: Endpoint) -> AsyncGenerator[Way, None]:
    async with serve(server, "http://127.0.0.1:0") as (url,):

        async def call(goal: Any = None, goal_id: GoalID | None = None) -> Told:
            path = f"/actions/{server.info.name}/goals"
            method, path = ("PUT", f"{path}/{goal_id}") if goal_id else ("POST", path)
            answer = await fetch(url, method, f"{path}?wait=9", goal)
            return told_by(answer, answer.json.get("result"))

        yield Way(url, call)


@asynccontextmanager
async def events(server: Endpoint) -> AsyncGenerator[Way, None]:
    async with serve(server, "http://127.0.0.1:0") as (url,):

        async def call(goal: Any = None, goal_id: GoalID | None = None) -> Told:
            path = f"/actions/{server.info.name}/goals"
            method, path = ("PUT", f"{path}/{goal_id}") if goal_id else ("POST", path)
            answer = await fetch(url, method, path, goal, accept="text/event-stream")
            return told_by(answer, answer.events[-1][2].get("result") if answer.events else None)

        yield Way(url, call)


@asynccontextmanager
async def rosbridge(server: Endpoint) -> AsyncGenerator[Way, None]:
    async with serve(server, "http://127.0.0.1:0") as (url,), socket_client(url) as client:

        async def call(goal: Any = None, goal_id: GoalID | None = None) -> Told:
            args = goal if isinstance(goal, dict) else {"data": goal}
            args = {} if goal is None else args
            await client.say(
                op="send_action_goal", action=server.info.name, args=args, id=str(goal_id or 1)
            )
            answer = (await client.hear_until("action_result"))[-1]
            if answer["result"]:
                return Told(answer["values"]["data"])
            code = answer.get("code")
            return Told(None, None if code is None else RejectionCode(code), answer["values"])

        yield Way(url, call)


def tools_of(agent: Talk, name: str) -> Callable[..., Awaitable[Told]]:
    async def call(goal: Any = MappingProxyType({})) -> Told:
        answer = await agent.call(name, **(goal if isinstance(goal, Mapping) else {"goal": goal}))
        if not answer.is_error:
            return Told(answer.structured_content["result"])
        return Told(reason=text_of(answer), is_later="try again later" in text_of(answer))

    return call


@asynccontextmanager
async def mcp(server: Endpoint) -> AsyncGenerator[Way, None]:
    here = InProcessTransport()
    async with (
        serve(server, here),
        McpBridge(here, UNASKED) as bridge,
        talk(bridge, "auto") as agent,
    ):
        yield Way("", tools_of(agent, server.info.name))


@asynccontextmanager
async def mcp_http(server: Endpoint) -> AsyncGenerator[Way, None]:
    transport = McpHttpTransport(port=0, token=TOKEN, unasked=["*"])
    async with serve(server, transport) as (url,), test_mcp_http.talking(url, "auto") as agent:
        yield Way(url, tools_of(agent, server.info.name))


@asynccontextmanager
async def a2a(server: Endpoint) -> AsyncGenerator[Way, None]:
    address = A2aHttpTransport(port=0, unasked=["*"], token=TOKEN)
    async with serve(server, address) as (url,), agent_talk.talking(url) as agent:

        async def call(goal: Any = None, goal_id: GoalID | None = None) -> Told:
            made = agent_talk.message(goal, skill=server.info.name)
            if goal is None:
                made.parts[0].text = ""
            if goal_id:
                made.message_id = str(UUID(bytes=bytes(goal_id)))
            try:
                task = await agent.send(made=made)
            except A2AError as exc:
                return Told(reason=str(exc))
            if agent_talk.state_of(task) == "COMPLETED":
                return Told(agent_talk.data_of(task.artifacts[-1].parts))
            code = MessageToDict(task.metadata).get("code")
            return Told(None, RejectionCode[code] if code else None, agent_talk.text_of(task))

        yield Way(url, call)


@asynccontextmanager
async def command(server: Endpoint) -> AsyncGenerator[Way, None]:
    async with serve(server, "tcp://127.0.0.1:0") as (url,):

        async def call(goal: Any = None) -> Told:
            said, text = io.StringIO(), "" if goal is None else json.dumps(goal)
            options = SendOptions(as_json=True)
            try:
                with redirect_stdout(said):
                    await send(url, server.info.name, "", text, options)
            except Failure as exc:
                return Told(reason=str(exc))
            event = json.loads(said.getvalue().splitlines()[-1])
            if event["event"] != "rejected":
                return Told(event["result"])
            return Told(None, RejectionCode[event["code"]], event["reason"])

        yield Way("", call)


def of_loopback(scheme: str) -> Callable[[], str]:
    return lambda: f"{scheme}://127.0.0.1:0"


def with_certificate(scheme: str) -> Callable[[], str]:
    return lambda: f"{scheme}://127.0.0.1:0?cert={pems().cert}"


DOORS: dict[str, Door] = {
    "inproc": by_client(InProcessTransport),
    "tcp": by_client(of_loopback("tcp")),
    "tls": by_client(with_certificate("tls")),
    "unix": by_client(unix_address),
    "ws": by_client(of_loopback("ws")),
    "wss": by_client(with_certificate("wss")),
    "rest": rest,
    "sse": events,
    "rosbridge": rosbridge,
    "rosbridge client": by_client(of_loopback("http"), "rosbridge"),
    "nats": by_client(nats_address),
    "mcp": mcp,
    "mcp http": mcp_http,
    "a2a": a2a,
    "command": command,
}
"""What opens each door, with a client of it."""
