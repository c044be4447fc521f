"""A server with actions of every temper, for tests that start it as a process.

    python -m tests.cli.robot URL...

It prints the URLs that it serves at, one a line, and stops on SIGTERM or SIGINT.
"""

from __future__ import annotations

import datetime
import logging
import sys
from collections.abc import AsyncGenerator
from functools import partial
from signal import SIGINT, SIGTERM
from typing import Annotated, Any, Literal

import anyio
import msgspec

from fibaction import (
    Action,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
    serve,
)
from tests.support.fibonacci import FIBONACCI, fibonacci


class Pose(msgspec.Struct):
    x: float = 0.0
    y: float = 0.0
    frame: str = "map"


class Gripper(msgspec.Struct, tag="gripper"):
    force: float


class Sucker(msgspec.Struct, tag="sucker"):
    vacuum: float = 0.5


class Pick(msgspec.Struct):
    """A goal with all kinds of fields."""

    object_name: str
    pose: Pose = msgspec.field(default_factory=Pose)
    speed: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.5
    retries: Annotated[int, msgspec.Meta(ge=0, le=255)] = 3
    mode: Literal["fast", "careful"] = "careful"
    tool: Gripper | Sucker | None = None
    waypoints: list[Pose] = []
    photo: bytes = b""
    start: datetime.datetime | None = None
    tags: dict[str, int] = {}
    dry_run: bool = False


class Progress(msgspec.Struct):
    progress: float
    step: str = ""


class Seen(msgspec.Struct):
    """The goal as the server has got it."""

    goal: Any


class Many(msgspec.Struct):
    count: int = 50_000


class Numbers(msgspec.Struct):
    numbers: list[int]


class Blob(msgspec.Struct):
    text: str


class Wait(msgspec.Struct):
    seconds: float = 3600.0
    steps: int = 1


class Waited(msgspec.Struct):
    seconds: float


class Words(msgspec.Struct):
    words: str = "füñf 鳥 🤖"


class Echoed(msgspec.Struct):
    echoed: str


class Said(msgspec.Struct):
    said: str


PICK = Action("arm/pick", goal=Pick, feedback=Progress, result=Seen, type_name="arm/action/Pick")
MANY = Action("many", goal=Many, feedback=Numbers, result=Blob)
WAIT = Action("wait", goal=Wait, feedback=Progress, result=Waited, type_name="arm/action/Wait")
STUBBORN = Action("stubborn", goal=Wait, feedback=Progress, result=Waited)
WORDS = Action("words", goal=Words, feedback=Said, result=Echoed)


async def pick(goal: GoalHandle[Pick]) -> AsyncGenerator[Progress | Seen, None]:
    """Report progress in four steps, and give back the goal."""
    if goal.request.object_name == "ghost":
        raise GoalAborted("there is no ghost")
    for step in range(1, 5):
        yield Progress(step / 4, f"step {step}")
    yield Seen(msgspec.to_builtins(goal.request))


def on_pick(goal: Pick) -> None:
    if goal.object_name == "sun":
        raise GoalRejected("the sun is too hot")


async def many(goal: GoalHandle[Many]) -> AsyncGenerator[Numbers | Blob, None]:
    """A large feedback, and a result of 100 times as many bytes as there are numbers."""
    yield Numbers(list(range(goal.request.count)))
    yield Blob("x" * (100 * goal.request.count))


async def wait(goal: GoalHandle[Wait]) -> AsyncGenerator[Progress | Waited, None]:
    """Wait, in steps; a cancel gives how long it has been."""
    request = goal.request
    began = anyio.current_time()
    try:
        for step in range(request.steps):
            yield Progress(step / request.steps, f"step {step}")
            await anyio.sleep(request.seconds / request.steps)
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled("asked to stop", result=Waited(anyio.current_time() - began)) from None
    yield Waited(request.seconds)


def refuse(_: GoalHandle[Wait]) -> None:
    raise CancelRejected("it is never canceled")


async def words(goal: GoalHandle[Words]) -> AsyncGenerator[Said | Echoed, None]:
    yield Said(goal.request.words)
    yield Echoed(goal.request.words)


def servers() -> list[ActionServer[Any, Any, Any]]:
    """All of them, new."""
    return [
        ActionServer(FIBONACCI, fibonacci, result_timeout=3600),
        ActionServer(PICK, pick, on_goal=on_pick, result_timeout=3600),
        ActionServer(MANY, many),
        ActionServer(WAIT, wait, result_timeout=3600, shutdown_timeout=0.5),
        ActionServer(STUBBORN, wait, on_cancel=refuse, shutdown_timeout=0.5),
        ActionServer(WORDS, words),
    ]


async def main(urls: list[str]) -> None:
    """Serve until a signal comes."""
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(servers(), *urls) as found:
            print(*found, sep="\n", flush=True)
            await anext(signals)


if __name__ == "__main__":
    logging.basicConfig()
    anyio.run(partial(main, sys.argv[1:]))
