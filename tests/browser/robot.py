"""A robot for tests in a browser: `python -m tests.browser.robot URL [TOKEN]` serves it.

Its actions are those that people send from a page: one with a single number, one with nested
fields, units and choices, one that waits in a queue, one that fails, and one with a flood of
feedback.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
import sys
from collections.abc import AsyncGenerator
from datetime import date, datetime
from typing import Annotated, Any, Literal

import anyio
import msgspec

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalHandle,
    GoalRejected,
    Schedule,
    serve,
)
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result


def unit(name: str) -> msgspec.Meta:
    return msgspec.Meta(extra_json_schema={"x-unit": name})


class Fix(msgspec.Struct):
    """A place on the earth."""

    latitude: float = 48.137
    longitude: float = 11.575


class Area(msgspec.Struct):
    """An area around the start, with a name."""

    radius: Annotated[float, unit("m")] = 10.0


class Flight(msgspec.Struct):
    """A way to fly, and when."""

    start: Annotated[datetime, msgspec.Meta(tz=True)]
    day: date
    route: list[Fix] = msgspec.field(default_factory=lambda: [Fix(), Fix(48.139, 11.58)])
    labels: dict[str, str] = {}
    areas: dict[str, Area] = msgspec.field(default_factory=lambda: {"near": Area()})


FLY = Action("fly", goal=Flight, feedback=Fix, result=str)


async def fly(goal: GoalHandle[Flight]) -> AsyncGenerator[Any, None]:
    """Fly to each place of the route, then tell what the goal is."""
    for place in goal.request.route:
        for share in range(1, 6):
            yield Fix(place.latitude - 0.0003 / share, place.longitude + 0.0004 / share)
            await anyio.sleep(0.01)
    yield repr(goal.request)


class Point(msgspec.Struct):
    """A place in the plane."""

    x: Annotated[float, unit("m")] = 0.0
    y: Annotated[float, unit("m")] = 0.0


class Drive(msgspec.Struct):
    """Where to drive, and how."""

    target: Point = msgspec.field(default_factory=lambda: Point(2.0, 1.0))
    speed: Annotated[float, msgspec.Meta(gt=0, le=2, description="Speed on straight lines")] = 0.5
    gear: Literal["slow", "normal", "fast"] = "normal"
    lights: bool = False
    stops: list[Point] = []
    note: str | None = None
    load: int | str = 0


class Driving(msgspec.Struct):
    """The place so far."""

    position: Point
    battery: Annotated[float, unit("%")]
    progress: float


class Driven(msgspec.Struct):
    """The way that was driven."""

    distance: Annotated[float, unit("m")]
    stops: list[Point]


class Load(msgspec.Struct):
    """How much feedback to send, and how fast."""

    rate: Annotated[int, msgspec.Meta(ge=1, le=10000, extra_json_schema={"x-unit": "1/s"})] = 1000
    seconds: float = 2.0


class Wave(msgspec.Struct):
    """One point of a wave."""

    value: float
    level: int
    samples: list[float]


class Cleaning(msgspec.Struct):
    """The room to clean."""

    room: str
    minutes: float = 0.02


class Cleaned(msgspec.Struct):
    """The share of the room that is clean."""

    percent: float


log = logging.getLogger("arm")
NUMBERS = itertools.count(100)
"""A default that no schema can tell."""
MOST = 10**15
"""The terms of a sequence are less. Messages have integers of 64 bits, so without a limit each goal
of a high order would abort at the 93rd term, after 5 s."""


class ToPoint(msgspec.Struct, tag="point"):
    """A place."""

    point: Point


class ToShelf(msgspec.Struct, tag="shelf"):
    """A shelf, by its number."""

    number: int = 3


class Fetch(msgspec.Struct):
    """A thing to fetch, and its place."""

    source: ToShelf | ToPoint
    target: ToPoint | ToShelf = msgspec.field(default_factory=lambda: ToShelf(7))
    spare: ToPoint | ToShelf = msgspec.field(default_factory=lambda: ToShelf(next(NUMBERS)))
    fallback: ToPoint | ToShelf | None = None


class Photo(msgspec.Struct):
    """A picture, and the size of the frames to show."""

    data: Annotated[bytes, msgspec.Meta(extra_json_schema={"contentMediaType": "image/png"})]
    size: Annotated[int, msgspec.Meta(ge=1, le=64, description="Pixels of an edge")] = 8


class Frame(msgspec.Struct):
    """An image of a camera, as ROS has it."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: bytes


class Round(msgspec.Struct):
    """The way of a guard so far, and what its camera sees."""

    battery: Annotated[float, unit("%")]
    camera: Frame


PATROL = Action("patrol", goal=float, feedback=Round, result=str)
LOOK = Action("look", goal=Photo, feedback=Frame, result=bytes)
COMPLETE = Action("complete", goal=str, feedback=str, result=int)
FETCH = Action("fetch", goal=Fetch, feedback=int, result=str)
DRIVE = Action("arm/drive", goal=Drive, feedback=Driving, result=Driven)
FLOOD = Action("flood", goal=Load, feedback=Wave, result=int)
CLEAN = Action("clean", goal=Cleaning, feedback=Cleaned, result=str)
MISSION = Action("mission", goal=Goal, feedback=Feedback, result=Result)
STUBBORN = Action("stubborn", goal=Goal, feedback=Feedback, result=Result)
BREAK = Action("break", goal=Goal, feedback=Feedback, result=Result)
ODD = Action("odd", goal=Goal, feedback=Feedback, result=msgspec.Raw)

Items = AsyncGenerator[Any, None]


async def fibonacci(goal: GoalHandle[Goal]) -> Items:
    """Compute a Fibonacci sequence slowly, of large terms the last digits."""
    sequence = [0, 1]
    for _ in range(goal.request.order - 1):
        await anyio.sleep(0.05)
        sequence.append((sequence[-1] + sequence[-2]) % MOST)
        yield Feedback(list(sequence))
    yield Result(sequence)


async def fetch(goal: GoalHandle[Fetch]) -> Items:
    """Tell what the goal is once it is read."""
    yield repr(goal.request)


def check_order(goal: Goal) -> None:
    """Reject a negative order."""
    if goal.order < 0:
        raise GoalRejected("the order is negative")


async def drive(goal: GoalHandle[Drive]) -> Items:
    """Drive in a curve; the fast gear is faster."""
    steps = {"slow": 100, "normal": 50, "fast": 10}[goal.request.gear]
    target = goal.request.target
    for step in range(1, steps + 1):
        await anyio.sleep(0.05)
        share = step / steps
        bend = math.sin(math.pi * share)
        position = Point(target.x * share, target.y * share + bend)
        yield Driving(position, 80 - 20 * share, share)
    yield Driven(math.hypot(target.x, target.y), goal.request.stops)


async def flood(goal: GoalHandle[Load]) -> Items:
    """Send feedback at a rate."""
    rate, step = goal.request.rate, 0
    begin = anyio.current_time()
    while (now := anyio.current_time() - begin) < goal.request.seconds:
        while step < now * rate:
            step += 1
            yield Wave(math.sin(step / 500), step % 100, [step / 10, math.cos(step / 300)])
        await anyio.sleep(0.005)
    yield step


async def clean(goal: GoalHandle[Cleaning]) -> Items:
    """Clean a room; one room at a time."""
    for percent in range(10, 101, 10):
        await anyio.sleep(goal.request.minutes * 6)
        yield Cleaned(percent)
    yield f"the {goal.request.room} is clean"


async def fail(goal: GoalHandle[Goal]) -> Items:
    """Send one feedback, then abort."""
    yield Feedback([goal.request.order])
    await anyio.sleep(0.05)
    log.warning("joint %d does not move", goal.request.order)
    raise GoalAborted("the arm is stuck", result=Result([goal.request.order]))


async def be_odd(goal: GoalHandle[Goal]) -> Items:
    """Give a result that is no value, such as one that was stored in another encoding."""
    await anyio.sleep(0.05)
    yield msgspec.Raw(b"\xc1")


async def wait(goal: GoalHandle[Goal]) -> Items:
    """Wait for a while."""
    await anyio.sleep(goal.request.order)
    yield Result([])


async def look(goal: GoalHandle[Photo]) -> Items:
    """Show frames that become green, then give the picture back."""
    size = goal.request.size
    for green in (0, 100, 200):
        data = bytes([50, green, 0]) * size * size
        yield Frame(size, size, "rgb8", 0, 3 * size, data)
        await anyio.sleep(0.02)
    yield goal.request.data


async def patrol(goal: GoalHandle[float]) -> Items:
    """Look around with a camera, for some seconds."""
    for red in (0, 100, 200):
        yield Round(red / 4, Frame(8, 8, "rgb8", 0, 24, bytes([red, 0, 0]) * 64))
        await anyio.sleep(goal.request)
    yield "nothing was seen"


async def complete(goal: GoalHandle[str]) -> Items:
    """Continue a text, piece by piece."""
    pieces = re.findall(r"\S+\s*", goal.request)
    for piece in pieces:
        yield piece
        await anyio.sleep(0.01)
    yield len(pieces)


def keep_on(goal: GoalHandle[Goal]) -> None:
    """Reject a cancel of an even order."""
    if goal.request.order % 2 == 0:
        raise CancelRejected("the arm must not stop here")


class Mission:
    """The executor of a mission: it computes two sequences, each as a step."""

    def __init__(self, sequences: ActionClient[Goal, Feedback, Result]) -> None:
        self._sequences = sequences

    async def __call__(self, goal: GoalHandle[Goal]) -> Items:
        """Compute the sequence of the order, and a short one."""
        first = await self._sequences.call(goal.request, step=goal.step("the long one"))
        yield Feedback(first.sequence)
        yield await self._sequences.call(Goal(1), step=goal.step("the short one"))


def servers() -> list[ActionServer[Any, Any, Any]]:
    """Return all servers of the robot."""
    sequences = ActionServer(FIBONACCI, fibonacci, on_goal=check_order, result_timeout=600)
    return [
        sequences,
        ActionServer(MISSION, Mission(ActionClient(sequences, FIBONACCI))),
        ActionServer(DRIVE, drive, result_timeout=600),
        ActionServer(FLOOD, flood),
        ActionServer(CLEAN, clean, schedule=Schedule(concurrency=1, queue=10)),
        ActionServer(BREAK, fail, log_lines=10),
        ActionServer(FETCH, fetch),
        ActionServer(LOOK, look),
        ActionServer(PATROL, patrol),
        ActionServer(COMPLETE, complete),
        ActionServer(ODD, be_odd),
        ActionServer(FLY, fly),
        ActionServer(STUBBORN, wait, on_cancel=keep_on),
    ]


async def main(url: str, token: str = "") -> None:
    """Serve until the process is ended."""
    settings: dict[str, Any] = {"tokens": {token: "operator"}} if token else {}
    async with serve(servers(), url, **settings) as (where,):
        print(where, flush=True)
        await anyio.sleep_forever()


if __name__ == "__main__":
    anyio.run(main, sys.argv[1], "".join(sys.argv[2:]))
