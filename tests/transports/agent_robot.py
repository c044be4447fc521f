"""A robot for the agents of others: `python -m tests.transports.agent_robot URL [ACTION...]`.

It serves its actions, or some of them, and prints the address. Those from `greet` on have the names
and do the work that the conformance suite of MCP asks for.
"""

from __future__ import annotations

import sys
from typing import Any

import anyio
import msgspec

from fibaction import ActionServer, GoalAborted, GoalRejected, Report, action, serve


class Arrived(msgspec.Struct):
    at: int


class Picture(msgspec.Struct):
    picture: bytes


@action
async def drive(meters: int, report: Report[int]) -> Arrived:
    """Drive straight on."""
    for meter in range(meters):
        await report(meter + 1)
        await anyio.sleep(0.02)
    return Arrived(meters)


def _check(goal: Any) -> None:
    if goal.meters < 0:
        raise GoalRejected("it cannot drive backwards")


@action
async def say(text: str, report: Report[str]) -> str:
    """Say a text in pieces."""
    for piece in text.split(" "):
        await report(f"{piece} ")
    return text


@action
async def greet(name: str) -> str:
    return f"Hello, {name}!"


@action
async def slow_compute(seconds: float = 0, label: str = "") -> str:
    await anyio.sleep(seconds)
    return label


@action
async def failing_job() -> str:
    raise GoalAborted("it fails always")


@action
async def confirm_delete(filename: str = "") -> str:
    return f"deleted {filename}"


@action
async def test_simple_text() -> str:
    return "This is a simple text response for testing."


@action
async def test_image_content() -> Picture:
    return Picture(b"\x89PNG\r\n\x1a\n and so on")


@action
async def test_error_handling() -> str:
    raise GoalAborted("This tool intentionally returns an error for testing")


@action
async def test_tool_with_progress(report: Report[float]) -> str:
    for percent in (0.0, 50.0, 100.0):
        await report(percent)
        await anyio.sleep(0.25)  # longer than the bridge waits between two reports
    return "done"


@action
async def test_elicitation(message: str) -> str:
    return message


@action
async def test_input_required_result_elicitation() -> str:
    return "Hello"


@action
async def test_input_required_result_request_state() -> str:
    return "state-ok"


@action
async def test_input_required_result_tampered_state() -> str:
    return "done"


SERVED = {drive.name: ActionServer(drive, on_goal=_check)} | {
    each.name: ActionServer(each)
    for each in (
        say,
        greet,
        slow_compute,
        failing_job,
        confirm_delete,
        test_simple_text,
        test_image_content,
        test_error_handling,
        test_tool_with_progress,
        test_elicitation,
        test_input_required_result_elicitation,
        test_input_required_result_request_state,
        test_input_required_result_tampered_state,
    )
}


async def main(*arguments: str) -> None:
    """Serve the actions until the process is ended."""
    url, *names = arguments
    async with serve([SERVED[name] for name in names or SERVED], url) as (served,):
        print(served, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, *sys.argv[1:])
