"""What type checkers must know of functions that are actions. Nobody runs this: mypy and pyright
read it.
"""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator, Coroutine
from typing import Any, Literal, TypedDict, assert_type

import msgspec

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    Arguments,
    FunctionAction,
    GoalHandle,
    Report,
    Return,
    action,
    blocking,
    call,
    connect,
    serve,
)
from fibaction.testing import Trial, run_executor


class Pose(msgspec.Struct):
    x: float


class Cup(TypedDict):
    size: int


@action
async def drive(report: Report[int], meters: int, speed: float = 1.0) -> str:
    assert_type(report, Report[int])
    await report(meters)
    await report("one")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
    return "there"


@action("arm/look")
async def look(what: str) -> Pose:
    return Pose(1)


@action
async def home() -> None: ...


@action(checkpoint=int)
async def wave(report: Report[float]) -> bool:
    await report(1)
    return True


@action
async def move(goal: GoalHandle[Pose], report: Report[Pose]) -> Pose:
    assert_type(goal.request, Pose)
    return goal.request


@action
async def turn(report: Report[int], goal: GoalHandle[object], angle: float) -> str:
    return str(goal.goal_id)


@action
async def wait(goal: GoalHandle[float]) -> None: ...


@action
async def pick(what: str, force: float, report: Report[int]) -> list[float]:
    return []


@action
async def place(what: str, force: float = 1.0) -> float:
    return force


@action
async def go(report: Report[str], pose: Pose) -> None: ...


@action
def press(report: Report[int], meters: int) -> str:
    report(meters)
    return "there"


@action
def weigh(goal: GoalHandle[object], what: str) -> float:
    goal.check()
    return 1.0


@action
def stop() -> None: ...


@action
async def turn_to(side: Literal["left", "right"], speed: float = 1.0) -> str:
    return side


@action
async def total(numbers: list[float]) -> float:
    return sum(numbers)


@action
async def fill(report: Report[int], cup: Cup) -> str:
    return ""


@action
async def four(a: int, b: str, c: float, d: bool, report: Report[int]) -> str:
    return b


@action
async def ready(goal: GoalHandle[None]) -> int:
    return goal.attempt


@action
async def ready_soon(report: Report[int], goal: GoalHandle[None]) -> int:
    return goal.attempt


@action
async def look_at(report: Report[int], goal: GoalHandle[Pose]) -> int:
    return int(goal.request.x)


@action
async def slow(report: Report[int], goal: GoalHandle[object], x: int, y: float = 1.0) -> str:
    return ""


@action
async def slow_last(x: int, goal: GoalHandle[object], report: Report[int]) -> str:
    return ""


@action
def wait_ready(goal: GoalHandle[None]) -> int:
    return goal.attempt


class Robot:
    @action
    async def of_request(self, goal: GoalHandle[Pose]) -> Pose:
        return goal.request

    @action
    async def of_none(self, goal: GoalHandle[None]) -> str:
        return ""

    @action
    async def of_request_last(self, report: Report[int], goal: GoalHandle[Pose]) -> str:
        return ""

    @action
    async def of_none_last(self, report: Report[int], goal: GoalHandle[None]) -> str:
        return ""

    @action
    async def with_handle(self, report: Report[int], goal: GoalHandle[object], x: int) -> str:
        return ""

    @action
    async def without_report(self, goal: GoalHandle[object], x: int) -> str:
        return ""

    @action
    async def move(self, report: Report[float], x: float) -> str:
        return "moved"

    @action
    async def grip(self, force: float = 1.0) -> bool:
        return force > 0

    @action("robot/halt")
    def halt(self) -> int:
        return 0

    @action
    async def drive_last(self, meters: int, report: Report[int]) -> str:
        return "there"

    async def drive(self, meters: int, report: Report[int]) -> str:
        return "there"


assert_type(look, FunctionAction[[str], None, Pose, Coroutine[Any, Any, Pose]])  # type: ignore[assert-type]  # pyright: ignore[reportAssertTypeFailure]  # the parameter has a name, too
assert_type(home, FunctionAction[[], None, None, Coroutine[Any, Any, None]])
assert_type(wave, FunctionAction[[], float, bool, Coroutine[Any, Any, bool]])
assert_type(move, FunctionAction[[Pose], Pose, Pose, Coroutine[Any, Any, Pose]])
assert_type(wait, FunctionAction[[float], None, None, Coroutine[Any, Any, None]])
assert_type(pick, FunctionAction[[str, float], int, list[float], Coroutine[Any, Any, list[float]]])
assert_type(stop, FunctionAction[[], None, None, None])
of_a_part = action(functools.partial(drive, speed=2.0))
of_a_method = action("drive")(Robot().drive)
an_action_too: Action[Any, int, str] = of_a_method

assert_type(ActionServer(drive), ActionServer[Any, int, str])
assert_type(ActionServer(pick, max_goals=1), ActionServer[Any, int, list[float]])
assert_type(pick.goal_of("cup", 1.0), Arguments[[str, float]])
an_action: Action[Any, int, str] = drive


def may_go(pose: Pose) -> None: ...


ActionServer(go, on_goal=may_go)

COUNT = Action("count", goal=int, feedback=int, result=int)
NOTHING = Action("nothing", goal=type(None), feedback=int, result=int)


async def count(goal: GoalHandle[int]) -> AsyncIterator[int | Return[int]]:
    yield 1
    yield Return(2)


assert_type(ActionServer(COUNT, count), ActionServer[int, int, int])


async def calls() -> None:
    assert_type(await call("inproc://a", drive, 3), str)
    assert_type(await call("inproc://a", drive, meters=3, speed=0.5), str)
    assert_type(await call("inproc://a", drive, 3, on_feedback=print, timeout=1), str)
    assert_type(await call("inproc://a", drive, drive.goal_of(3, speed=2), timeout=1), str)
    assert_type(await call("inproc://a", home), None)
    assert_type(await call("inproc://a", wave, heartbeat=2.0), bool)
    assert_type(await call("inproc://a", turn, angle=1.5), str)
    assert_type(await call("inproc://a", weigh, what="cup"), float)
    assert_type(await call("inproc://a", pick, "cup", 1.0), list[float])
    assert_type(await call("inproc://a", pick, pick.goal_of("cup", 1.0)), list[float])
    assert_type(await call("inproc://a", go, Pose(1), timeout=3), None)
    assert_type(await call("inproc://a", press, 3), str)
    assert_type(await call("inproc://a", COUNT, 3, timeout=3), int)
    assert_type(await call("inproc://a", NOTHING), int)
    assert_type(await call("inproc://a", Robot.move, x=3.0), str)
    assert_type(await call("inproc://a", Robot.grip), bool)
    assert_type(await call("inproc://a", Robot.grip, force=2.0), bool)
    assert_type(await call("inproc://a", Robot.halt, timeout=3), int)
    assert_type(await call("inproc://a", Robot.drive_last, 3), str)
    assert_type(await Robot().move(3.0), str)
    assert_type(await call("inproc://a", turn_to, "left"), str)
    assert_type(await call("inproc://a", turn_to, turn_to.goal_of("left"), timeout=3), str)
    assert_type(await call("inproc://a", total, [1, 2]), float)
    assert_type(await call("inproc://a", fill, {"size": 3}), str)
    assert_type(await call("inproc://a", four, 1, "a", 1.0, True), str)
    assert_type(await call("inproc://a", ready), int)
    assert_type(await call("inproc://a", ready, timeout=3), int)
    assert_type(await call("inproc://a", ready_soon, timeout=3), int)
    assert_type(await call("inproc://a", wait_ready, timeout=3), int)
    assert_type(await call("inproc://a", look_at, Pose(1), timeout=3), int)
    assert_type(await call("inproc://a", slow, 3, y=2.0), str)
    assert_type(await call("inproc://a", slow_last, 3), str)
    assert_type(await call("inproc://a", Robot.of_request, Pose(1)), Pose)
    assert_type(await call("inproc://a", Robot.of_none), str)
    assert_type(await call("inproc://a", Robot.of_request_last, Pose(1)), str)
    assert_type(await call("inproc://a", Robot.of_none_last), str)
    assert_type(await call("inproc://a", Robot.with_handle, x=1), str)
    assert_type(await call("inproc://a", Robot.without_report, x=1), str)
    await call("inproc://a", of_a_part, 3)
    print(await call("inproc://a", drive, 3, speed=2), await run_executor(drive, 3, speed=2))
    print(await call("inproc://a", Robot.grip, force=2.0))
    # mypy is wrong here: see docs/howto/types.md.
    await call("inproc://a", turn_to, "left", timeout=3)  # type: ignore[call-arg]
    await call("inproc://a", total, [1, 2], timeout=3)  # type: ignore[call-arg]
    await call("inproc://a", fill, {"size": 3}, timeout=3)  # type: ignore[call-arg]
    assert_type(await drive(3, report=print), str)
    assert_type(press(3), str)


async def clients() -> None:
    robot = Robot()
    async with serve(drive, "inproc://a"), serve([drive, ActionServer(pick)], "inproc://b"):
        async with connect("inproc://a", drive) as client:
            assert_type(await client.call(3), str)
            assert_type(await client.call(3, speed=0.5), str)
            assert_type(await client.call(3, on_feedback=print), str)
            async with client.send_goal(meters=3) as goal:
                assert_type(await goal.result(), str)
            async with client.send_goal(3, timeout=5) as goal:
                assert_type(await goal.result(), str)
    async with serve(robot, "inproc://a"), serve([robot.move, robot.grip], "inproc://b"):
        async with connect("inproc://a", Robot.move) as mover:
            assert_type(mover, ActionClient[Arguments[[float]], float, str])  # type: ignore[assert-type]  # pyright: ignore[reportAssertTypeFailure]  # the parameter has a name, too
        async with connect("inproc://a", Robot.grip) as gripper:
            assert_type(await gripper.call(), bool)
            assert_type(await gripper.call(timeout=3), bool)
    async with connect("inproc://a", NOTHING) as nothing, connect("inproc://a", COUNT) as counter:
        assert_type(await nothing.call(), int)
        assert_type(await nothing.call(timeout=3), int)
        assert_type(await counter.call(3, on_feedback=print), int)


def blocks() -> None:
    with blocking.connect("tcp://127.0.0.1:7400", drive) as client:
        assert_type(client.call(3, speed=0.5), str)
        assert_type(client.call(3, on_feedback=print), str)
        assert_type(client.send_goal(meters=3).result(), str)
    assert_type(blocking.call("tcp://127.0.0.1:7400", drive, meters=3), str)
    assert_type(blocking.call("tcp://127.0.0.1:7400", drive, 3, on_feedback=print), str)


async def trials() -> None:
    assert_type(await run_executor(drive, 3), Trial[int, str])
    assert_type(await run_executor(drive, meters=3, speed=0.5), Trial[int, str])
    assert_type(await run_executor(drive, 3, cancel_after=1), Trial[int, str])
    assert_type(await run_executor(COUNT, count, 3), Trial[int, int])


async def wrong() -> None:
    """Refused, each line of it."""
    drive.goal_of()  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    drive.goal_of("x", y=2)  # type: ignore[call-arg, arg-type]  # pyright: ignore[reportCallIssue]
    pick.goal_of("cup")  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    Robot.move.goal_of()  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    Robot().move.goal_of("x")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
    await call("inproc://a", drive)  # type: ignore[arg-type]  # pyright: ignore[reportCallIssue]
    await call("inproc://a", drive, "three")  # type: ignore[misc]  # pyright: ignore[reportArgumentType, reportCallIssue]
    await call("inproc://a", drive, 3, sped=2)  # type: ignore[call-arg]  # pyright: ignore[reportCallIssue]
    await call("inproc://a", home, 3)  # type: ignore[arg-type]  # pyright: ignore[reportCallIssue]
    async with connect("inproc://a", drive) as client:
        await client.call()  # type: ignore[call-overload]  # pyright: ignore[reportCallIssue]
        await client.call("x")  # type: ignore[call-overload]  # pyright: ignore[reportArgumentType, reportCallIssue]
        await client.call(3, on_feedback=lambda done: done.foo)  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]
