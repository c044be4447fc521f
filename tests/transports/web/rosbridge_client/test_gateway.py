"""`rosbridge://` with a server of fibaction, which speaks rosbridge at `http://`."""

from __future__ import annotations

import base64
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ActionServer,
    AuthenticationFailed,
    CancelCode,
    ClientConnection,
    ConnectionLost,
    Endpoint,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    InvalidMessage,
    ServerNotFound,
    connect,
    serve,
)
from fibaction.interfaces.ros_types import array, struct
from fibaction.schema.payload import JsonCodec, PayloadError
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.matching import End
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


async def test_a_goal_has_its_feedback_and_its_result() -> None:
    async with client_of(Robot()) as client:
        goal = await client.send_goal(Goal(3))
        assert [one.partial_sequence async for one in goal.feedback] == [[0], [0, 3]]
        assert await goal.result() == Result([3])
        assert (goal.status, goal.feedback_dropped) == (GoalStatus.SUCCEEDED, 0)


async def test_a_goal_without_feedback_ends_as_well() -> None:
    async with client_of(Robot()) as client:
        assert await client.call(Goal(3)) == Result([3])


async def test_a_rejected_goal_has_the_reason_of_the_server() -> None:
    async with client_of(Robot()) as client:
        with pytest.raises(GoalRejected) as caught:
            await client.send_goal(Goal(-1))
        assert caught.value.reason == "order is negative"


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


async def test_the_end_of_a_block_cancels_its_goal() -> None:
    robot = Robot()
    async with client_of(robot) as client:
        async with client.send_goal(Goal(50)):
            pass
        await robot.ended.wait()


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


async def test_two_goals_run_at_once_and_are_told_apart() -> None:
    robot = Robot()
    async with client_of(robot) as client:
        one, other = await client.send_goal(Goal(50)), await client.send_goal(Goal(51))
        await one.cancel()
        assert await one.outcome() == End(GoalStatus.CANCELED)
        assert other.status is GoalStatus.EXECUTING
        robot.go_on.set()
        assert await other.result() == Result([51])


async def test_all_goals_are_canceled_by_the_service_of_ros() -> None:
    robot = Robot()
    async with client_of(robot) as client:
        goals = [await client.send_goal(Goal(50)) for _ in range(2)]
        answer = await client.cancel_goals()
        assert (answer.return_code, len(answer.goals_canceling)) == (CancelCode.NONE, 2)
        for goal in goals:
            assert (await goal.outcome()).status is GoalStatus.CANCELED
        assert (await client.cancel_goals(before=5)).goals_canceling == ()


async def test_a_cancel_of_all_goals_can_be_rejected() -> None:
    robot = Robot()
    robot.refuses_cancels = True
    async with client_of(robot) as client:
        goal = await client.send_goal(Goal(50))
        answer = await client.cancel_goals()
        assert (answer.return_code, answer.reason) == (CancelCode.REJECTED, "it is nearly done")
        robot.go_on.set()
        assert await goal.result() == Result([50])


async def test_the_actions_are_listed_with_their_types() -> None:
    async with connected(Robot().server) as connection:
        (info,) = await connection.actions()
        assert (info.name, info.type_name) == ("fibonacci", "arduinobot_msgs/action/Fibonacci")
        untyped = connection.client(Action.untyped(info))
        assert await untyped.call({"order": 4}) == {"sequence": [4]}


async def test_the_actions_are_listed_with_their_schemas() -> None:
    async with connected(Robot().server) as connection:
        (info,) = await connection.actions()
        with pytest.raises(PayloadError, match=r"goal\.order must be a whole number"):
            JsonCodec(info.goal).encode({"order": "many"})
        with pytest.raises(PayloadError, match=r"order is missing"):
            JsonCodec(info.goal).encode({})
        assert JsonCodec(info.feedback).complete({"partial_sequence": [1]})
        assert JsonCodec(info.result).complete({"sequence": [1]})


async def test_an_action_whose_type_is_not_known_is_listed_without_schemas() -> None:
    untyped = Action("idle", goal=Goal, feedback=Feedback, result=Result)
    async with connected(ActionServer(untyped, Robot())) as connection:
        assert await connection.actions() == [ActionInfo("idle")]


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


async def test_a_server_is_waited_for() -> None:
    async with client_of(Robot()) as client:
        await client.wait_for_server()
        other = client.endpoint
        assert other.info.name == "fibonacci"


async def test_an_action_that_is_not_served_is_not_found() -> None:
    other = Action("other", goal=Goal, feedback=Feedback, result=Result)
    async with connected(Robot().server) as connection:
        with pytest.raises(ServerNotFound, match="the action '/other' is not served"):
            await connection.client(other).send_goal(Goal(1))


async def test_goals_end_with_the_reason_when_the_server_stops() -> None:
    async with serve(Robot().server, "http://127.0.0.1:0") as (url,):
        connection = await connect(url.replace("http", "rosbridge"), FIBONACCI)
        goal = await connection.send_goal(Goal(50))
    with anyio.fail_after(10):
        outcome = await goal.outcome()
        assert outcome.status is GoalStatus.ABORTED
        assert "stopped" in outcome.reason
        with pytest.raises(ServerNotFound, match="no server listens at rosbridge://"):
            await connection.send_goal(Goal(1))
        await connection.aclose()


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


async def test_a_gateway_serves_the_robot_again() -> None:
    async with connected(Robot().server) as behind:
        async with (
            serve(behind.endpoint(FIBONACCI), "tcp://127.0.0.1:0") as (url,),
            connect(url, FIBONACCI) as client,
        ):
            goal = await client.send_goal(Goal(3))
            assert [one.partial_sequence async for one in goal.feedback] == [[0], [0, 3]]
            assert await goal.result() == Result([3])
            with pytest.raises(GoalRejected, match="order is negative"):
                await client.send_goal(Goal(-1))


async def test_a_token_goes_into_the_request() -> None:
    with anyio.fail_after(30):
        async with serve(Robot().server, "http://127.0.0.1:0", tokens={"secret": "me"}) as (url,):
            url = url.replace("http", "rosbridge")
            async with connect(url, FIBONACCI, token="secret") as client:
                assert await client.call(Goal(3)) == Result([3])
            async with connect(url, FIBONACCI) as client:
                with pytest.raises((AuthenticationFailed, ConnectionLost), match="token"):
                    await client.send_goal(Goal(3))


async def test_a_goal_of_more_bytes_than_rosbridge_takes_is_not_sent() -> None:
    text = Action("say", goal=str, feedback=int, result=str)

    async def say(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        yield 1
        yield goal.request

    async with connected(ActionServer(text, say)) as connection:
        client = connection.client(text)
        with pytest.raises(InvalidMessage, match="as JSON, and rosbridge takes 10000000"):
            await client.send_goal("x" * 10_000_000)
        # A value that is not an object is in a field `data`, both ways.
        goal = await client.send_goal("hello")
        assert [one async for one in goal.feedback] == [1]
        assert await goal.result() == "hello"


async def test_bytes_cross_both_ways_for_a_client_without_types() -> None:
    look = Action("look", goal=Shot, feedback=int, result=Shot, type_name="a/action/Look")

    async def run(goal: GoalHandle[Shot]) -> AsyncGenerator[Any, None]:
        yield 1
        yield goal.request

    async with connected(ActionServer(look, run)) as connection:
        (info,) = await connection.actions()
        client = connection.client(Action.untyped(info))
        for pixels in ("", "AAH/", base64.b64encode(bytes(100_000)).decode()):
            goal = JsonCodec(info.goal).complete({"pixels": pixels, "parts": [{"raw": "/w=="}]})
            assert await client.call(goal) == {
                "pixels": base64.b64decode(pixels),
                "parts": [{"raw": b"\xff"}],
            }


class Part(msgspec.Struct):
    raw: bytes = b""


class Shot(msgspec.Struct):
    pixels: bytes
    parts: list[Part] = []


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
