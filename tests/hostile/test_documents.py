"""The worst JSON documents at each door that takes JSON: the event loop goes on, and all is told.

Each pause of a check is made to wait for a turn of the event loop. A check in the loop itself would
have no such turn, and one that does not pause would have too few of them.
"""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, TypeAlias

import anyio
import anyio.from_thread
import pytest

from fibaction import ActionServer, GoalHandle, Limits, serve
from fibaction.schema import turns
from fibaction.schema.steps import STEPS, STEPS_PER_VALUE, TURN, Extent
from fibaction_transports.inprocess import InProcessTransport
from fibaction_transports.mcp import McpBridge
from tests.hostile.documents import ANYTHING, DOCUMENTS, NUMBERS, TREE, Document
from tests.transports.mcp.robot import UNASKED, talk
from tests.transports.web.http_client import fetch
from tests.transports.web.rosbridge.clients import socket_client

pytestmark = pytest.mark.asyncio

SIZE = 2**17
"""Bytes of the largest message."""
Door: TypeAlias = Callable[[], AbstractAsyncContextManager[Callable[[Document, str], Any]]]


async def end(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    yield 1


def servers() -> list[ActionServer[Any, Any, Any]]:
    return [ActionServer(action, end) for action in (TREE, NUMBERS, ANYTHING)]


@asynccontextmanager
async def rest() -> AsyncGenerator[Any, None]:
    async with serve(servers(), "http://127.0.0.1:0", limits=Limits(frame=SIZE)) as (url,):

        async def send(document: Document, text: str) -> bool:
            path = f"/actions/{document.action}/goals"
            answer = await fetch(url, "POST", path, text.encode())
            assert answer.status in (201, 422), answer.body
            return answer.status == 201

        yield send


@asynccontextmanager
async def rosbridge() -> AsyncGenerator[Any, None]:
    async with serve(servers(), "http://127.0.0.1:0", limits=Limits(frame=SIZE + 500)) as (url,):
        async with socket_client(url) as client:

            async def send(document: Document, text: str) -> bool:
                args = text if document.action != "numbers" else f'{{"data":{text}}}'
                head = f'{{"op":"send_action_goal","action":"{document.action}","args":'
                await client.say(f"{head}{args}}}")
                heard = await client.hear_until("action_result")
                return bool(heard[-1]["result"])

            yield send


@asynccontextmanager
async def mcp() -> AsyncGenerator[Any, None]:
    here = InProcessTransport()
    async with (
        serve(servers(), here),
        McpBridge(here, UNASKED) as bridge,
        talk(bridge, "auto") as made,
    ):

        async def send(document: Document, text: str) -> bool:
            data = json.loads(text)
            arguments = data if isinstance(data, dict) else {"goal": data}
            return not (await made.call(document.action, **arguments)).is_error

        yield send


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The turns of the loop so far, one for each pause of a check."""
    taken = [0]

    def take() -> None:
        taken[0] += 1

    monkeypatch.setattr(turns, "_pause", lambda: anyio.from_thread.run_sync(take))
    return taken


@pytest.mark.parametrize("name", DOCUMENTS)
@pytest.mark.parametrize("door", [rest, rosbridge, mcp])
async def test_the_loop_goes_on_while_a_document_is_checked(
    door: Door, name: str, pauses: list[int]
) -> None:
    document = DOCUMENTS[name]
    text = document.text(SIZE)
    size = Extent.of(json.loads(text)).size

    with anyio.fail_after(60):
        async with door() as send:
            assert await send(document, text) == document.is_goal
    # At most the steps of the check, and those of the search for what is wrong.
    assert pauses[0] <= (2 * STEPS + STEPS_PER_VALUE * size) / TURN + 2
    if document.action != "anything":  # which is not checked
        assert pauses[0] >= (
            size / TURN / 3 if document.is_goal and document.action == "tree" else 1
        )
