"""`rosbridge://` with a server of fibaction, which speaks rosbridge at `http://`."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    CancelCode,
    ClientConnection,
    ConnectionLost,
    Endpoint,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalRejected,
    connect,
    serve,
)
from fibaction.interfaces.ros_types import array, struct
from fibaction.schema.payload import JsonCodec, PayloadError
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.transports.web.rosbridge.robot import Robot

pytestmark = pytest.mark.anyio


@asynccontextmanager
async def connected(
    *endpoints: Endpoint, **settings: Any
) -> AsyncGenerator[ClientConnection, None]:
    with anyio.fail_after(30):
        async with (
            serve(endpoints, "http://127.0.0.1:0") as (url,),
            connect(url.replace("http", "rosbridge"), **settings) as connection,
        ):
            yield connection


@asynccontextmanager
async def client_of(
    robot: Robot, **settings: Any
) -> AsyncGenerator[ActionClient[Goal, Feedback, Result], None]:
    async with connected(robot.server, **settings) as connection:
        yield connection.client(FIBONACCI)


async def test_a_goal_that_was_rejected_may_be_sent_again() -> None:
    robot, goal_id = Robot(), GoalID.random()
    async with client_of(robot) as client:
        for _ in range(2):
            with pytest.raises(GoalRejected, match="order is negative"):
                await client.send_goal(Goal(-1), goal_id=goal_id)
        goal = await client.send_goal(Goal(3), goal_id=goal_id)
        assert await goal.result() == Result([3])


async def test_aborted_goals_have_their_reason_and_their_result() -> None:
    async with client_of(Robot()) as client:
        with pytest.raises(GoalAborted, match="six is too many") as caught:
            await client.call(Goal(6))
        assert caught.value.result is None
        with pytest.raises(GoalAborted, match="seven is too many") as caught:
            await client.call(Goal(7))
        assert caught.value.result == Result([7])


async def test_a_cancel_arrives_and_the_partial_result_comes_back() -> None:
    async with client_of(Robot()) as client:
        goal = await client.send_goal(Goal(51))
        answer = await goal.cancel()
        assert answer.accepted
        assert [one.goal_id for one in answer.goals_canceling] == [goal.goal_id]
        with pytest.raises(GoalCanceled, match="stopped") as caught:
            await goal.result()
        assert caught.value.result == Result([5, 1])
        assert (await goal.cancel()).return_code is CancelCode.GOAL_TERMINATED


async def test_the_end_of_the_connection_cancels_the_goals_of_open_blocks() -> None:
    robot = Robot()
    async with serve(robot.server, "http://127.0.0.1:0") as (url,):
        with anyio.fail_after(10):
            async with connect(url.replace("http", "rosbridge"), FIBONACCI) as client:
                goal = await client.send_goal(Goal(50)).__aenter__()
            await robot.ended.wait()
        with pytest.raises(ConnectionLost, match="was closed here; the goal may run on"):
            await goal.outcome()
        with pytest.raises(ConnectionLost, match="was closed here"):
            await client.send_goal(Goal(1))


async def test_the_actions_are_listed_with_their_schemas() -> None:
    async with connected(Robot().server) as connection:
        (info,) = await connection.actions()
        with pytest.raises(PayloadError, match=r"goal\.order must be a whole number"):
            JsonCodec(info.goal).encode({"order": "many"})
        with pytest.raises(PayloadError, match=r"order is missing"):
            JsonCodec(info.goal).encode({})
        assert JsonCodec(info.feedback).complete({"partial_sequence": [1]})
        assert JsonCodec(info.result).complete({"sequence": [1]})


async def test_values_that_are_not_objects_have_the_schema_of_a_field() -> None:
    text = Action("say", goal=bytes, feedback=int, result=list[str], type_name="a/action/Say")

    async def say(goal: GoalHandle[bytes]) -> AsyncGenerator[int | list[str], None]:
        yield 1
        yield [goal.request.decode()]

    async with connected(ActionServer(text, say)) as connection:
        (info,) = await connection.actions()
        payload = JsonCodec(info.goal).complete({"data": "aGVsbG8="})
        assert payload == {"data": b"hello"}
        async with connection.client(Action.untyped(info)).send_goal(payload) as goal:
            assert [one async for one in goal.feedback] == [{"data": 1}]
            assert await goal.result() == {"data": ["hello"]}


async def test_the_same_goal_is_sent_once() -> None:
    robot = Robot()
    async with client_of(robot) as client:
        goal_id = GoalID.random()
        goal = await client.send_goal(Goal(50), goal_id=goal_id)
        again = await client.send_goal(Goal(50), goal_id=goal_id)
        with pytest.raises(GoalRejected, match="its ID is in use by another goal"):
            await client.send_goal(Goal(51), goal_id=goal_id)
        followed = await client.attach(goal_id, after=1)
        robot.go_on.set()
        assert await goal.result() == await again.result() == await followed.result()
        assert [one.partial_sequence async for one in again.feedback] == [[0], [0, 50]]
        assert [one.partial_sequence async for one in followed.feedback] == [[0, 50]]
        assert robot.runs == 1


class Pixels(msgspec.Struct):
    data: bytes
    scale: float


async def test_bytes_and_special_floats_cross_as_rosbridge_has_them() -> None:
    nested: Any = struct("Nested", [("raw", array(int), [])], module="m", doc="", constants={})
    look = Action("look", goal=Pixels, feedback=nested, result=list[Pixels])

    async def run(goal: GoalHandle[Pixels]) -> AsyncGenerator[Any, None]:
        yield nested(raw=[1, 2])
        yield [goal.request, Pixels(b"\0\xff", float("nan")), Pixels(b"", float("inf"))]

    async with connected(ActionServer(look, run)) as connection:
        client = connection.client(look)
        goal = await client.send_goal(Pixels(b"\1\2\xfe", 0.5))
        assert [one.raw async for one in goal.feedback] == [[1, 2]]
        first, second, third = await goal.result()
        assert first == Pixels(b"\1\2\xfe", 0.5)
        assert second.data == b"\0\xff"
        # rosbridge writes null for both: NaN says that it is not a number that can be told.
        assert str(second.scale) == str(third.scale) == "nan"
        with pytest.raises(GoalRejected, match="NaN or infinite, which rosbridge cannot carry"):
            await client.send_goal(Pixels(b"", float("-inf")))
