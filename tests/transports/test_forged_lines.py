"""No line of a log is forged, in programs that log as docs/howto/secure.md shows."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import anyio
import msgspec
import pytest
from anyio.abc import SocketAttribute, SocketStream

from fibaction import ActionServer, serve
from fibaction.wire.frames import FrameReader, framed
from fibaction.wire.messages import (
    VERSION,
    CancelGoals,
    Ended,
    Failed,
    Following,
    FromServer,
    Goodbye,
    Hello,
    Rejected,
    SendGoal,
    Welcome,
    decode_from_client,
    encode,
)
from fibaction.words.statuses import GoalStatus
from tests.support.processes import PATIENCE, ended
from tests.transports.hearing import hearing, raw
from tests.transports.log_victim import NASTY, STRICT, never

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/howto/secure.md"
RECORD = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (fibaction\.\w+|robot): \S")
LONG = 500_000
REJECTED = {"strict", "picky", "broken"}

pytestmark = pytest.mark.asyncio


@contextlib.contextmanager
def victim(*arguments: str) -> Generator[subprocess.Popen[str], None, None]:
    """Run a process that logs to its standard error."""
    command = [sys.executable, "-m", "tests.transports.log_victim", *arguments]
    pipe = subprocess.PIPE
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([".", "transports"])}
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        yield process
        process.kill()


def check(log: str) -> list[str]:
    """Return the lines of a log, each of which is of a record, or of the traceback below it."""
    lines = re.split("[\n\r\x85\u2028]", log.rstrip("\n"))
    for line in lines:
        assert line.isprintable()
        assert RECORD.match(line) or line.startswith("  "), line
    return lines


def hostile_goals(text: str) -> Iterator[tuple[str, bytes]]:
    yield "strict", msgspec.msgpack.encode({text: 1})
    yield "strict", msgspec.msgpack.encode([{text: 1}])
    for name in ("failing", "grouping", "aborting", "picky", "broken", "stubborn"):
        yield name, msgspec.msgpack.encode(text)
    yield text, b"\x80"


async def test_the_page_shows_the_log_that_is_tested() -> None:
    line = 'logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")'
    assert line in PAGE.read_text()
    assert line in Path(__file__).with_name("log_victim.py").read_text()


@pytest.mark.promise("ERROR-5")
@pytest.mark.parametrize("size", [0, LONG], ids=["short", "long"])
async def test_no_goal_writes_a_line_of_its_own(size: int) -> None:
    text = NASTY + "\nforged: x\x1b" * (size // 10)
    with victim("serve") as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        async with raw(url) as client:
            await client.say(encode(Hello(VERSION, 60, "secret")))
            goals = list(hostile_goals(text))
            for request, (action, goal) in enumerate(goals, 1):
                name = request.to_bytes(16, "big")
                await client.say(encode(SendGoal(request, action, name, goal, None)))
            await client.say(encode(CancelGoals(99, "stubborn", None, None)))
            # Large goals are checked in a thread, and so rejected later.
            awaited = {
                99,
                *(number for number, (name, _) in enumerate(goals, 1) if name in REJECTED),
            }
            while awaited:
                said = await client.hear()
                if not isinstance(said, Following):
                    awaited.discard(getattr(said, "id", 0))
            await client.say(encode(Goodbye(text)))
            await client.hear_all()
        async with raw(url) as other:
            await other.say(encode(Hello(VERSION, 60, f"key{NASTY}")))
            await other.hear_all()
        done = ended(process)

    lines = check(done.err)
    assert len([line for line in lines if "rejected: " in line]) == 4
    assert len([line for line in lines if " left: " in line]) == 1
    assert any("ValueError" in line and line.startswith("  ") for line in lines)
    assert len(done.err) < 3000 * len(goals)
    assert "secret" not in done.err


Answer = Callable[[SendGoal], list[FromServer]]


def followed(goal: SendGoal, *more: FromServer) -> list[FromServer]:
    return [Following(goal.id, 1, GoalStatus.EXECUTING, False, 0), *more]


def hostile_answers(text: str) -> list[Answer]:
    """Return an answer to each goal in turn; the last one ends the client."""
    return [
        lambda goal: [Rejected(goal.id, text)],
        lambda goal: followed(goal, Ended(goal.id, GoalStatus.ABORTED, None, text, 0)),
    ]


LAST_WORDS: dict[str, Callable[[SendGoal, str], list[FromServer]]] = {
    "an error": lambda goal, text: [Failed(goal.id, 8, text)],
    "feedback": lambda goal, text: followed(
        goal, Ended(goal.id, GoalStatus.SUCCEEDED, msgspec.msgpack.encode({text: 1}), text, 0)
    ),
    "goodbye": lambda goal, text: [Goodbye(text, 4)],
    "another goodbye": lambda goal, text: [Goodbye(text)],
}


@pytest.mark.promise("ERROR-5")
@pytest.mark.parametrize("last", LAST_WORDS)
@pytest.mark.parametrize("size", [0, LONG], ids=["short", "long"])
async def test_no_server_writes_a_line_of_its_own(last: str, size: int) -> None:
    text = NASTY + "\nforged: x\x1b" * (size // 10)
    answers = hostile_answers(text)

    async def serve_one(stream: SocketStream) -> None:
        reader = FrameReader()
        async with stream:
            with contextlib.suppress(anyio.EndOfStream, anyio.BrokenResourceError):
                while True:
                    for frame in reader.feed(await stream.receive()):
                        message = decode_from_client(frame)
                        said: list[FromServer] = []
                        if isinstance(message, Hello):
                            said = [Welcome(VERSION, 60)]
                        elif isinstance(message, SendGoal):
                            said = (
                                answers.pop(0)(message)
                                if answers
                                else LAST_WORDS[last](message, text)
                            )
                        await stream.send(framed([encode(one) for one in said]))

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        port = listener.extra(SocketAttribute.local_port)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listener.serve, serve_one)
            with victim("connect", f"tcp://127.0.0.1:{port}") as process:
                done = await anyio.to_thread.run_sync(ended, process)
            tasks.cancel_scope.cancel()

    lines = check(done.err)
    assert done.code == 0
    assert len([line for line in lines if "robot: it failed: " in line]) == 3
    assert len(done.err) < 1500 * len(lines) < 10_000


async def test_rejected_goals_leave_nothing_behind() -> None:
    goals, names = 20, [f"{number}{'x' * LONG}" for number in range(20)]
    payloads = [msgspec.msgpack.encode({name: 1}) for name in names]
    async with serve(ActionServer(STRICT, never), "tcp://127.0.0.1:0") as (url,):
        async with raw(url) as client:
            await client.say(encode(Hello(VERSION, 60)))
            await client.hear()
            for count in range(2):  # the first round is for what is made once
                gc.collect()
                gc.disable()  # what is in a cycle is kept for too long
                tracemalloc.start()
                try:
                    with anyio.fail_after(PATIENCE), hearing() as heard:
                        before = tracemalloc.get_traced_memory()[0]
                        for number, payload in enumerate(payloads, 1 + count * goals):
                            name = number.to_bytes(16, "big")
                            await client.say(encode(SendGoal(number, "strict", name, payload, 0)))
                            answer = await client.hear()
                            assert isinstance(answer, Rejected)
                            assert len(answer.reason) <= 200
                        # The thread of the checks lets go of the last goal before its next work.
                        await anyio.to_thread.run_sync(int)
                        kept = tracemalloc.get_traced_memory()[0] - before
                    assert len(heard.records) == 0
                finally:
                    tracemalloc.stop()
                    gc.enable()
    assert kept < LONG
