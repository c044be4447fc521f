"""What type checkers must know of functions that are actions. Nobody runs this: mypy and pyright
read it.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Coroutine
from typing import Any, assert_type

import msgspec

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    FunctionAction,
    GoalFields,
    GoalHandle,
    Report,
    Return,
    action,
    call,
    connect,
    serve,
)


class Pose(msgspec.Struct):
    x: float


@action("drive")
async def drive(meters: int, report: Report[int]) -> str:
    assert_type(report, Report[int])
    await report(meters)
    await report("one")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
    return "there"


@action("look")
async def look(what: str) -> Pose:
    return Pose(1)


@action("home")
async def home() -> None: ...


@action("wave")
async def wave(report: Report[float]) -> bool:
    await report(1)
    return True


@action("move")
async def move(goal: GoalHandle[Pose], report: Report[Pose]) -> Pose:
    assert_type(goal.request, Pose)
    return goal.request


@action("turn")
async def turn(angle: float, goal: GoalHandle[float], report: Report[int]) -> str:
    return str(goal.goal_id)


@action("wait")
async def wait(goal: GoalHandle[float]) -> None: ...


@action("pick")
async def pick(what: str, force: float, speed: float, report: Report[int]) -> list[float]:
    return []


@action("place")
async def place(what: str, force: float = 1.0) -> float:
    return force


@action("press")
def press(meters: int, report: Report[int]) -> str:
    report(meters)
    return "there"


@action("weigh")
def weigh(what: str, goal: GoalHandle[str]) -> float:
    goal.check()
    return 1.0


@action("stop")
def stop() -> None: ...


class Robot:
    @staticmethod
    def unused() -> None: ...

    async def drive(self, meters: int, report: Report[int]) -> str:
        return "there"


assert_type(drive, FunctionAction[int, int, str, Coroutine[Any, Any, str]])
assert_type(look, FunctionAction[str, None, Pose, Coroutine[Any, Any, Pose]])
assert_type(home, FunctionAction[None, None, None, Coroutine[Any, Any, None]])
assert_type(wave, FunctionAction[None, float, bool, Coroutine[Any, Any, bool]])
assert_type(move, FunctionAction[Pose, Pose, Pose, Coroutine[Any, Any, Pose]])
assert_type(turn, FunctionAction[float, int, str, Coroutine[Any, Any, str]])
assert_type(wait, FunctionAction[float, None, None, Coroutine[Any, Any, None]])
assert_type(pick, FunctionAction[GoalFields, int, list[float], Coroutine[Any, Any, list[float]]])
assert_type(place, FunctionAction[GoalFields, None, float, Coroutine[Any, Any, float]])
assert_type(press, FunctionAction[int, int, str, str])
assert_type(weigh, FunctionAction[str, None, float, float])
assert_type(stop, FunctionAction[None, None, None, None])
of_a_method = action("drive")(Robot().drive)
assert_type(of_a_method, FunctionAction[int, int, str, Coroutine[Any, Any, str]])

assert_type(ActionServer(drive), ActionServer[int, int, str])
assert_type(ActionServer(pick, max_goals=1), ActionServer[GoalFields, int, list[float]])
assert_type(pick.goal_of("cup", force=1), GoalFields)
an_action: Action[int, int, str] = drive

COUNT = Action("count", goal=int, feedback=int, result=int)


async def count(goal: GoalHandle[int]) -> AsyncIterator[int | Return[int]]:
    yield 1
    yield Return(2)


assert_type(ActionServer(COUNT, count), ActionServer[int, int, int])


async def main() -> None:
    async with serve(drive, "inproc://a"), serve([drive, ActionServer(pick)], "inproc://b"):
        async with connect("inproc://a", drive) as client:
            assert_type(client, ActionClient[int, int, str])
            assert_type(await client.call(3), str)
    assert_type(await call("inproc://a", drive, 3, on_feedback=print, timeout=1), str)
    print(await call("inproc://a", drive, 3), await call("inproc://a", COUNT, 3))
    assert_type(await call("inproc://a", home), None)
    assert_type(await call("inproc://a", wave, heartbeat=2.0), bool)
    assert_type(await call("inproc://a", pick, pick.goal_of("cup")), list[float])
    await call("inproc://a", drive, "three")  # type: ignore[misc]  # pyright: ignore[reportArgumentType, reportCallIssue]  # must be refused
    assert_type(await drive(3, report=print), str)
    assert_type(press(3), str)
