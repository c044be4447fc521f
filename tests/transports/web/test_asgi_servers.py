"""A FastAPI program with a `WebTransport`, in the ASGI servers that people use."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import pytest

from fibaction import GoalInfo, GoalStatus, connect
from tests.support.fibonacci import FIBONACCI, Goal, Result
from tests.transports.web.http_client import client_of, fetch

pytestmark = pytest.mark.anyio

ROOT = Path(__file__).resolve().parents[3]
APP = "tests.transports.web.fastapi_program:app"
SERVERS = {
    "uvicorn": ["uvicorn", APP, "--port", "PORT", "--ws", "wsproto"],
    "hypercorn": ["hypercorn", APP, "--bind", "127.0.0.1:PORT"],
    "hypercorn on trio": ["hypercorn", "-k", "trio", APP, "--bind", "127.0.0.1:PORT"],
    "granian": ["granian", "--interface", "asgi", APP, "--port", "PORT"],
}
GOALS = "/robot/actions/fibonacci/goals"


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@asynccontextmanager
async def running(name: str) -> AsyncGenerator[str, None]:
    """Run the program in a process, and end it."""
    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as probe:
        port = str(probe.extra(anyio.abc.SocketAttribute.local_port))
    command = [part.replace("PORT", port) for part in SERVERS[name]]
    process = subprocess.Popen(  # noqa: ASYNC220  # it returns at once
        [str(Path(sys.executable).with_name(command[0])), *command[1:]],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        with anyio.fail_after(30):
            while True:
                try:
                    async with await anyio.connect_tcp("127.0.0.1", int(port)):
                        break
                except OSError:
                    assert process.poll() is None
                    await anyio.sleep(0.05)  # a process of others does not say when it listens
        yield f"http://127.0.0.1:{port}"
        process.send_signal(signal.SIGTERM)
        await anyio.to_thread.run_sync(process.wait, 20)
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("name", SERVERS)
async def test_a_program_of_fastapi_serves_goals_in(name: str) -> None:
    async with running(name) as url:
        answer = await fetch(url, "POST", f"{GOALS}?wait=10", {"order": 0})
        assert (answer.status, answer.json["status"]) == (201, "SUCCEEDED")
        assert answer.headers["location"].startswith(GOALS)
        streamed = await fetch(url, "POST", GOALS, {"order": 0}, accept="text/event-stream")
        assert [event for event, _, _ in streamed.events][-2:] == ["feedback", "result"]
        wire = url.replace("http", "ws") + "/robot/"
        with anyio.fail_after(20):
            async with connect(wire, FIBONACCI) as client:
                assert await client.call(Goal(0)) == Result([])
                async with client_of(url) as cut:
                    await cut.ask("POST", GOALS, {"order": 60}, accept="text/event-stream")
                    await cut.until("id: 1")
                async with client.events() as events:
                    async for event in events:
                        if isinstance(event, GoalInfo) and event.status is GoalStatus.CANCELED:
                            break
