"""What type checkers must know of a user's program. Nobody runs this: mypy and pyright read it."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import dataclass
from functools import partial
from typing import Any, assert_type

import msgspec
from pydantic import BaseModel

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ActionServer,
    CancelAnswer,
    ClientConnection,
    ClientGoal,
    GoalHandle,
    GoalID,
    GoalStatus,
    Outcome,
    Sender,
    connect,
    serve,
)
from fibaction.testing import ScriptedServer, Trial, run_executor
from fibaction_transports.ros2 import Node, Publisher
from tests.action_files.drive_types import (
    SET_BOOL,
    SetBool_Request,
    SetBool_Response,
    Twist,
)


class Goal(msgspec.Struct):
    order: int


@dataclass
class Feedback:
    partial_sequence: list[int]


class Result(msgspec.Struct):
    sequence: list[int]


FIBONACCI = Action("fibonacci", goal=Goal, feedback=Feedback, result=Result)
assert_type(FIBONACCI, Action[Goal, Feedback, Result])
assert_type(Action("sum", goal=list[int], feedback=str, result=int), Action[list[int], str, int])
assert_type(Action.untyped(ActionInfo("any")), Action[Any, Any, Any])


async def fibonacci(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    assert_type(goal.request, Goal)
    assert_type(goal.goal_id, GoalID)
    assert_type(goal.sender, Sender)
    goal.order  # type: ignore[attr-defined]  # pyright: ignore[reportAttributeAccessIssue]  # noqa: B018  # must be refused
    assert_type(goal.status, GoalStatus)
    assert_type(goal.cancel_requested, bool)
    yield Feedback([0, 1])
    yield Result([0, 1])


async def as_iterator(goal: GoalHandle[Goal]) -> AsyncIterator[Feedback | Result]:
    yield Feedback([0, 1])
    yield Result([0, 1])


async def iterates_over_something_else(goal: GoalHandle[Goal]) -> AsyncIterator[int]:
    yield 1


class Robot:
    async def drive(self, goal: GoalHandle[Goal]) -> AsyncIterator[Feedback | Result]:
        yield Result([0, 1])


class Model(BaseModel):
    order: int


class Progress(BaseModel):
    done: float


MODELS = Action("models", goal=Model, feedback=Progress, result=Result)
assert_type(MODELS, Action[Model, Progress, Result])


async def of_models(goal: GoalHandle[Model]) -> AsyncIterator[Progress | Result]:
    assert_type(goal.request.order, int)
    yield Progress(done=1)
    yield Result([goal.request.order])


assert_type(ActionServer(MODELS, of_models), ActionServer[Model, Progress, Result])


def on_goal(goal: Goal) -> None: ...


async def on_cancel(goal: GoalHandle[Goal]) -> None: ...


def with_sender(goal: Goal, sender: Sender) -> None: ...


async def decides_later(goal: Goal, sender: Sender) -> None: ...


class Policy:
    def on_goal(self, goal: Goal) -> None: ...

    async def with_sender(self, goal: Goal, sender: Sender) -> None: ...

    def __call__(self, goal: Goal, sender: Sender) -> None: ...


def configured(limit: int, goal: Goal, sender: Sender) -> None: ...


def of_another_action(goal: int) -> None: ...


def of_three(goal: Goal, sender: Sender, more: int) -> None: ...


async def yields_something_else(goal: GoalHandle[Goal]) -> AsyncGenerator[int, None]:
    yield 1


server = ActionServer(FIBONACCI, fibonacci, on_goal=on_goal, on_cancel=on_cancel)
assert_type(server, ActionServer[Goal, Feedback, Result])
for accepted in (
    ActionServer(FIBONACCI, as_iterator),
    ActionServer(FIBONACCI, Robot().drive),
    ActionServer(FIBONACCI, fibonacci, on_goal=with_sender),
    ActionServer(FIBONACCI, fibonacci, on_goal=decides_later),
    ActionServer(FIBONACCI, fibonacci, on_goal=Policy()),
    ActionServer(FIBONACCI, fibonacci, on_goal=Policy().on_goal),
    ActionServer(FIBONACCI, fibonacci, on_goal=Policy().with_sender),
    ActionServer(FIBONACCI, fibonacci, on_goal=partial(configured, 10)),
    ActionServer(FIBONACCI, fibonacci, on_goal=lambda goal: None),
    ActionServer(FIBONACCI, fibonacci, on_goal=lambda goal, sender: None),
):
    assert_type(accepted, ActionServer[Goal, Feedback, Result])
ActionServer(FIBONACCI, fibonacci, on_goal=of_three)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
ActionServer(FIBONACCI, fibonacci, on_goal=of_another_action)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
ActionServer(FIBONACCI, yields_something_else)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
ActionServer(FIBONACCI, iterates_over_something_else)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused
ActionServer(FIBONACCI, fibonacci, feedback="some")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused


async def main() -> None:
    async with server as entered:
        assert_type(entered, ActionServer[Goal, Feedback, Result])
    async with serve(server, "inproc://a", "inproc://b") as urls:
        assert_type(urls, tuple[str, ...])

    servers = await serve(server, "inproc://a")
    assert_type(servers.urls, tuple[str, ...])
    await servers.aclose()

    async with connect("inproc://a") as connection:
        assert_type(connection, ClientConnection)
        assert_type(connection.client(FIBONACCI), ActionClient[Goal, Feedback, Result])
        assert_type(await connection.actions(), list[ActionInfo])

    async with connect("inproc://a", FIBONACCI) as client:
        assert_type(client, ActionClient[Goal, Feedback, Result])
        async with client.send_goal(Goal(order=10)) as goal:
            assert_type(goal, ClientGoal[Feedback, Result])
            async for feedback in goal.feedback:
                assert_type(feedback, Feedback)
            async for one in goal:
                assert_type(one, Feedback)
            assert_type(await goal.result(), Result)
            assert_type(await goal.outcome(), Outcome[Result])
            assert_type(await goal.cancel(), CancelAnswer)
        assert_type(await client.send_goal(Goal(order=10)), ClientGoal[Feedback, Result])
        assert_type(await client.call(Goal(order=10), on_feedback=print), Result)
        assert_type(await client.attach(GoalID.random()), ClientGoal[Feedback, Result])
        assert_type((await goal.outcome()).result, Result | None)
        client.send_goal(10)  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]  # must be refused


async def tests() -> None:
    await run_executor(FIBONACCI, as_iterator, Goal(3))
    trial = await run_executor(FIBONACCI, fibonacci, Goal(3), cancel_after=1)
    assert_type(trial, Trial[Feedback, Result])
    assert_type(trial.feedback, list[Feedback])
    async with ScriptedServer(FIBONACCI, [Feedback([1]), Result([2])]) as scripted:
        assert_type(scripted, ScriptedServer[Goal, Feedback, Result])
        assert_type(scripted.received, list[Goal])


async def topics_and_services_have_the_types_of_generated_classes(node: Node) -> None:
    async for twist in node.subscribe("cmd_vel", Twist):
        assert_type(twist.linear.x, float)
    publisher = node.publisher("cmd_vel", Twist)
    assert_type(publisher, Publisher[Twist])
    await publisher.publish(Twist())
    await publisher.publish({"linear": {"x": 0.2}})
    await publisher.publish(SetBool_Request())  # type: ignore[arg-type]
    answer = await node.call("lamp", SET_BOOL, SetBool_Request(data=True), timeout=1)
    assert_type(answer, SetBool_Response)
    await node.call("lamp", SET_BOOL, SetBool_Response())  # type: ignore[misc]
    assert_type(await node.call("lamp", "std_srvs/srv/SetBool", {"data": True}), Any)

    async def lamp(request: SetBool_Request) -> SetBool_Response:
        return SetBool_Response(success=request.data)

    with (
        node.serve_service("lamp", SET_BOOL, lamp),
        node.serve_service("other", SET_BOOL, lambda request: {"success": request.data}),
    ):
        pass
    speed = node.parameters().declare("speed", 0.5)
    assert_type(speed, float)
