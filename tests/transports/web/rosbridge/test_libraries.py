"""Programs of roslibjs 2 and roslibpy 2, which know rosbridge only."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import serve
from tests.support.node import IS_LEFT_OUT, MISSING, run_node
from tests.support.processes import Finished, ended
from tests.transports.web.rosbridge.robot import Robot

pytestmark = pytest.mark.anyio

PROGRAMS = Path(__file__).with_name("programs")
needs_node = pytest.mark.skipif(IS_LEFT_OUT, reason=MISSING)
TOKEN = "correct-horse"


async def javascript(folder: Path, *arguments: str, name: str = "roslibjs.mjs") -> Finished:
    program = (PROGRAMS / name).read_text()
    return await anyio.to_thread.run_sync(lambda: run_node(folder, program, *arguments))


async def python(*arguments: str, name: str = "roslibpy_program.py") -> Finished:
    process = subprocess.Popen(  # noqa: ASYNC220  # it returns at once
        [sys.executable, str(PROGRAMS / name), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONWARNINGS": "default"},
    )
    return await anyio.to_thread.run_sync(lambda: ended(process))


@asynccontextmanager
async def served(**settings: Any) -> AsyncGenerator[str, None]:
    with anyio.fail_after(50):
        async with serve(Robot().server, "http://127.0.0.1:0", **settings) as (url,):
            yield url.replace("http", "ws")


def feedback(*orders: int) -> list[dict[str, list[int]]]:
    return [{"partial_sequence": [0]}, *({"partial_sequence": [0, order]} for order in orders)]


@needs_node
@pytest.mark.parametrize("token", ["", TOKEN])
async def test_a_program_of_roslibjs_works_unchanged(token: str, tmp_path: Path) -> None:
    tokens = {token: "page"} if token else None
    async with served(tokens=tokens) as url:
        finished = await javascript(tmp_path, url, *([token] if token else []))
    # `cancelAllGoals` calls without an ID, and roslibjs does not expect the answer of rosbridge.
    assert (finished.code, finished.err) == (0, "Received service response without ID\n")
    failed = "GoalError: Action"
    assert finished.json == [
        {"feedback": feedback(3), "result": {"sequence": [3]}},
        {"feedback": [], "error": f"{failed} status unknown: order is negative"},
        {"feedback": feedback(6), "error": f"{failed} was aborted: six is too many"},
        {"feedback": feedback(7), "error": f'{failed} was aborted: {{"sequence":[7]}}'},
        {"feedback": feedback(50), "error": f"{failed} was canceled: {{}}"},
        {
            "feedback": [],
            "error": f'{failed} status unknown: goal.order must be a whole number, not "x"',
        },
        [f"{failed} was canceled: {{}}"] * 2,
        ["/fibonacci"],
        {"type": "arduinobot_msgs/action/Fibonacci"},
        {
            "error": "the service '/add_two_ints' is not served here: there are actions,"
            " their /_action/cancel_goal and parts of rosapi"
        },
    ]


@pytest.mark.parametrize("transport", ["asyncio", "twisted"])
@pytest.mark.parametrize("token", ["", TOKEN])
async def test_a_program_of_roslibpy_works_unchanged(token: str, transport: str) -> None:
    async with served(tokens={token: "arm"} if token else None) as url:
        finished = await python(url, transport, token)
    assert finished.code == 0, finished.err
    assert "Traceback" not in finished.err
    lines = finished.json
    assert lines[:6] == [
        {"feedback": feedback(3), "result": ["SUCCEEDED", {"sequence": [3]}]},
        {"feedback": [], "error": ["UNKNOWN", "order is negative"]},
        {"feedback": feedback(6), "error": ["ABORTED", "six is too many"]},
        {"feedback": feedback(7), "result": ["ABORTED", {"sequence": [7]}]},
        {"feedback": feedback(50), "result": ["CANCELED", {}]},
        {"feedback": [], "error": ["UNKNOWN", 'goal.order must be a whole number, not "x"']},
    ]
    assert lines[6]["error"][1].startswith("JSON is malformed")
    assert lines[7:9] == [
        {"action_servers": ["/fibonacci"]},
        {"type": "arduinobot_msgs/action/Fibonacci"},
    ]
    assert "is not served here" in lines[9]["error"]


TOPICS = [
    ["/fibonacci/_action/feedback", "/fibonacci/_action/status"],
    ["arduinobot_msgs/action/Fibonacci_FeedbackMessage", "action_msgs/msg/GoalStatusArray"],
    feedback(3),
]


@needs_node
async def test_a_program_of_roslibjs_watches_the_goals_of_others(tmp_path: Path) -> None:
    async with served() as url:
        finished = await javascript(tmp_path, url, name="topics.mjs")
    assert (finished.code, finished.err) == (0, "")
    assert finished.json == [TOPICS]


@pytest.mark.parametrize("transport", ["asyncio", "twisted"])
async def test_a_program_of_roslibpy_watches_the_goals_of_others(transport: str) -> None:
    async with served() as url:
        finished = await python(url, transport, name="topics_program.py")
    assert finished.code == 0, finished.err
    assert "Traceback" not in finished.err
    assert finished.json == [TOPICS]
