"""NATS: a goal is a request, and all feedback and the result come to its inbox.

A server of NATS stands between the two. The payloads are the same as fibaction's, behind a byte
that says what they are. NATS holds no sender back, so the reader's buffers are as large as need be.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import anyio
from anyio import create_task_group

from tests.tools.benchmarks.contender import (
    AT_ONCE,
    PACED,
    PAUSE,
    Contender,
    seconds_since,
    stamped,
)
from tests.tools.benchmarks.inprocess import ACTION, Feedback, Goal, Result

SUBJECT = "count"
FEEDBACK, RESULT = b"f", b"r"
PATIENCE = 30.0
"""Seconds for an answer."""
START_TIMEOUT = 10.0
UNPACKED = Path(__file__).parents[3] / ".venv" / "nats" / "usr" / "sbin"
"""The file to which `make bench` downloads the server of NATS, if none is installed."""


def nats_server() -> str | None:
    """Return the path of the server's program."""
    return shutil.which("nats-server") or shutil.which("nats-server", path=f"{UNPACKED}:/usr/sbin")


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    import nats

    async with broker() as url:
        client = await nats.connect(url)

        async def answer(request: Any) -> None:
            wanted = ACTION.goal.decode(request.data).count
            if wanted >= PACED:
                for _ in range(wanted - PACED):
                    await anyio.sleep(PAUSE)
                    await request.respond(FEEDBACK + ACTION.feedback.encode(Feedback(stamped())))
            else:
                feedback = Feedback([1, 2, 3])
                for _ in range(wanted):
                    await request.respond(FEEDBACK + ACTION.feedback.encode(feedback))
            await request.respond(RESULT + ACTION.result.encode(Result(wanted)))

        await client.subscribe(SUBJECT, cb=answer)
        await client.flush()
        try:
            yield url
        finally:
            await client.close()


@asynccontextmanager
async def broker() -> AsyncGenerator[str, None]:
    """Run a server of NATS at a free port of this machine; the block gets its URL."""
    program = nats_server()
    assert program is not None
    with TemporaryDirectory() as folder:
        command = [program, "-a", "127.0.0.1", "-p", "-1", "--ports_file_dir", folder]
        async with await anyio.open_process(command, stderr=None) as process:
            try:
                yield await ports_file(anyio.Path(folder))
            finally:
                process.terminate()


async def ports_file(folder: anyio.Path) -> str:
    """Return the URL, from the file that the server writes when it listens."""
    with anyio.fail_after(START_TIMEOUT):
        while True:
            async for path in folder.glob("*.ports"):
                if text := await path.read_text(encoding="utf-8"):
                    return str(json.loads(text)["nats"][0])
            await anyio.sleep(0.01)


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    import nats

    client = await nats.connect(address)
    try:
        yield OverNats(client)
    finally:
        await client.close()


class OverNats(Contender):
    def __init__(self, client: Any) -> None:
        self._client = client

    async def goals(self, times: int) -> None:
        for _ in range(times):
            await self._call()

    async def batches(self, times: int) -> int:
        for _ in range(times):
            async with create_task_group() as tasks:
                for _ in range(AT_ONCE):
                    tasks.start_soon(self._call)
        return times * AT_ONCE

    async def feedback(self, times: int) -> int:
        return len([feedback async for feedback in self._feedback(times)])

    async def feedback_times(self, times: int) -> list[float]:
        return [seconds_since(one.numbers) async for one in self._feedback(PACED + times)]

    async def _call(self) -> None:
        answer = await self._client.request(SUBJECT, ACTION.goal.encode(Goal(0)), timeout=PATIENCE)
        assert answer.data[:1] == RESULT
        ACTION.result.decode(answer.data[1:])

    async def _feedback(self, number: int) -> AsyncGenerator[Feedback, None]:
        inbox = self._client.new_inbox()
        answers = await self._client.subscribe(
            inbox, pending_msgs_limit=number + 1, pending_bytes_limit=2**30
        )
        await self._client.publish(SUBJECT, ACTION.goal.encode(Goal(number)), reply=inbox)
        while True:
            answer = await answers.next_msg(timeout=PATIENCE)
            if answer.data[:1] == RESULT:
                break
            yield ACTION.feedback.decode(answer.data[1:])
        assert ACTION.result.decode(answer.data[1:]) == Result(number)
        await answers.unsubscribe()
