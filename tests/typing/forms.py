"""What type checkers must know of the types that an action may have: each claim of
`docs/howto/types.md`. Nobody runs this: mypy and pyright read it.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import Enum
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NewType,
    TypeAlias,
    TypedDict,
    assert_type,
)

import msgspec
from msgspec import Meta

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    FunctionAction,
    GoalHandle,
    Report,
    action,
    connect,
)
from fibaction.blocking import connect as connect_blocking


class Grip(msgspec.Struct):
    force: float


@dataclass
class Pose:
    x: float


class Distance(TypedDict):
    meters: float


class Point(NamedTuple):
    x: float


class Mode(Enum):
    FAST = "fast"


Meters = NewType("Meters", float)
Percent: TypeAlias = Annotated[int, Meta(ge=0, le=100)]
Tool: TypeAlias = Grip | Pose
Part: TypeAlias = Literal["arm", "gripper"]

# Classes and builtins

assert_type(Action("a", goal=Grip, feedback=Pose, result=Distance), Action[Grip, Pose, Distance])
assert_type(
    Action("a", goal=Point, feedback=Mode, result=list[float]), Action[Point, Mode, list[float]]
)

# Forms that are not classes

assert_type(
    Action("a", goal=Annotated[int, Meta(ge=0)], feedback=Percent, result=Part),
    Action[int, int, Part],
)
assert_type(
    Action("a", goal=Grip | Pose, feedback=Tool, result=int | None),
    Action[Tool, Tool, int | None],
)
assert_type(
    Action("a", goal=Literal["up", "down"], feedback=Meters, result=dict[str, Meters]),
    Action[Literal["up", "down"], Meters, dict[str, Meters]],
)
assert_type(Action("a", goal=None, feedback=None, result=None), Action[None, None, None])
assert_type(
    Action("a", goal=list[Annotated[float, Meta(gt=0)]], feedback=int, result=int | None),
    Action[list[float], int, int | None],
)
Action("a", goal=3, feedback=int, result=int)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
Action("a", goal=Grip(1), feedback=int, result=int)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused

# In executors, servers and clients

MOVE = Action("move", goal=Percent, feedback=Tool, result=None)
LOOK = Action("look", goal=None, feedback=Meters, result=Part)


async def move(goal: GoalHandle[int]) -> AsyncIterator[Tool | None]:
    yield Grip(goal.request)
    yield Pose(goal.request)
    yield None


async def look(goal: GoalHandle[None]) -> AsyncIterator[Meters | Part]:
    yield Meters(1.0)
    yield "arm"


async def looks_elsewhere(goal: GoalHandle[None]) -> AsyncIterator[Meters | Literal["leg"]]:
    yield "leg"


assert_type(ActionServer(MOVE, move), ActionServer[int, Tool, None])
assert_type(ActionServer(LOOK, look), ActionServer[None, Meters, Part])
ActionServer(LOOK, looks_elsewhere)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType, reportCallIssue]  # must be refused


async def main() -> None:
    async with connect("inproc://robot", MOVE) as client:
        assert_type(client, ActionClient[int, Tool, None])
        assert_type(await client.call(3), None)
        async with client.send_goal(3) as goal:
            async for tool in goal.feedback:
                assert_type(tool, Tool)
            assert_type((await goal.outcome()).result, None)
        await client.call("three")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
    async with connect("inproc://robot", LOOK) as looking:
        assert_type(await looking.call(), Part)
    with connect_blocking("tcp://robot", LOOK) as blocking:
        assert_type(blocking.call(), Part)


# Functions


@action("turn")
async def turn(angle: Percent, report: Report[int | str]) -> None:
    await report("on the way")
    await report(1.5)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused


@action("choose")
async def choose(part: Part, report: Report[Meters]) -> list[int] | None:
    return None


@action("measure")
def measure(over: Meters | None) -> Annotated[float, Meta(ge=0)]:
    return 1.0


functions: list[FunctionAction[..., Any, Any, Any]] = [turn, choose, measure]
turning: Action[Any, int | str, None] = turn
choosing: Action[Any, Meters, list[int] | None] = choose
measuring: Action[Any, None, float] = measure
