"""Goals of rosbridge clients, through the server of `http://` and through an application."""

from __future__ import annotations

import base64
import json
from typing import Any

import anyio
import pytest
from anyio.lowlevel import checkpoint
from wsproto.events import CloseConnection, TextMessage

from fibaction import RejectionCode
from tests.transports.web.rosbridge.clients import Serving, SocketClient
from tests.transports.web.rosbridge.robot import Robot, feedback, goal, result

pytestmark = pytest.mark.anyio


async def test_every_end_is_told_as_the_libraries_show_it(serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        for order, expected in [
            (-1, result("order is negative", 0, ok=False, code=0)),
            (6, result("six is too many", 6, ok=False)),
            (7, result({"sequence": [7]}, 6, reason="seven is too many")),
        ]:
            await client.say(goal(order))
            assert (await client.hear_until("action_result"))[-1] == expected


@pytest.mark.parametrize(
    "kind", ["arduinobot_msgs/action/Fibonacci", "arduinobot_msgs/Fibonacci", "", None]
)
async def test_a_goal_may_name_its_type_in_each_form(kind: str | None, serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(1, feedback=False, action_type=kind))
        assert await client.hear() == result({"sequence": [1]})


async def test_a_goal_of_another_type_is_told_what_the_action_has(serving: Serving) -> None:
    robot = Robot()
    async with serving(robot.server) as served, served.connect() as client:
        await client.say(goal(1, action_type="nav2_msgs/action/Spin"))
        why = (
            "the type of 'fibonacci' is arduinobot_msgs/action/Fibonacci, and not"
            " nav2_msgs/action/Spin"
        )
        assert await client.hear() == result(why, 0, ok=False, code=RejectionCode.UNREADABLE)
    assert robot.runs == 0


@pytest.mark.parametrize(
    ("order", "values", "reason"), [(50, {}, {}), (51, {"sequence": [5, 1]}, {"reason": "stopped"})]
)
async def test_a_cancel_arrives_at_once(
    order: int, values: Any, reason: Any, serving: Serving
) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(order))
        assert await client.hear() == feedback(0)
        await client.say(op="cancel_action_goal", id="g1", action="fibonacci")
        heard = await client.hear_until("action_result")
        assert heard[-1] == result(values, 5, **reason)
        # The goal is unknown now, and rosbridge has no answer to that.
        await client.say(op="cancel_action_goal", id="g1", action="fibonacci")
        await client.say(goal(-1))
        assert (await client.hear())["values"] == "order is negative"


async def test_a_cancel_that_is_rejected_leaves_the_goal_running(serving: Serving) -> None:
    robot = Robot()
    robot.refuses_cancels = True
    async with serving(robot.server) as served, served.connect() as client:
        await client.say(goal(50, feedback=False))
        await client.say(op="cancel_action_goal", id="g1", action="/fibonacci")
        cancel_all = "/fibonacci/_action/cancel_goal"
        await client.say(op="call_service", service=cancel_all, args={})
        answer = await client.hear()
        assert answer["values"]["return_code"] == 1
        assert answer["values"]["reason"] == "it is nearly done"
        robot.go_on.set()
        assert await client.hear() == result({"sequence": [50]})


async def test_a_goal_may_have_a_number_as_its_id_or_none(serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(1, id=7, feedback=False))
        assert await client.hear() == result({"sequence": [1]}, id=7)
        without = goal(2, feedback=False)
        del without["id"]
        await client.say(without)
        expected = result({"sequence": [2]})
        del expected["id"]
        assert await client.hear() == expected
        await client.say(without | {"args": {"order": 50}})
        await client.say(op="cancel_action_goal", action="/fibonacci")
        assert (await client.hear())["status"] == 5


async def test_of_two_goals_with_the_same_id_the_later_is_canceled(serving: Serving) -> None:
    robot = Robot()
    async with serving(robot.server) as served, served.connect() as client:
        await client.say(goal(50, feedback=False))
        await client.say(goal(52, feedback=False))
        await client.say(op="cancel_action_goal", id="g1", action="/fibonacci")
        assert await client.hear() == result({}, 5)
        robot.go_on.set()
        assert await client.hear() == result({"sequence": [50]})


async def test_all_goals_are_canceled_by_a_service(serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(50, feedback=False))
        cancel_all = {"op": "call_service", "service": "/fibonacci/_action/cancel_goal"}
        await client.say(cancel_all | {"args": {}})
        heard = [await client.hear(), await client.hear()]
        heard.sort(key=lambda message: str(message["op"]))
        assert heard[0] == result({}, 5)
        (canceled,) = heard[1]["values"].pop("goals_canceling")
        uuid = base64.b64decode(canceled["goal_id"]["uuid"])
        assert len(uuid) == 16
        assert canceled["stamp"]["sec"] > 10**9
        assert heard[1] == {
            "op": "service_response",
            "service": "/fibonacci/_action/cancel_goal",
            "values": {"return_code": 0},
            "result": True,
        }
        for value in (canceled["goal_id"]["uuid"], list(uuid)):
            info = {"goal_id": {"uuid": value}, "stamp": {"sec": 0, "nanosec": 0}}
            await client.say(cancel_all | {"id": 1, "args": {"goal_info": info}})
            answer = await client.hear()
            assert (answer["id"], answer["values"]["return_code"]) == (1, 3)


async def test_goals_up_to_a_time_are_canceled_by_a_service(serving: Serving) -> None:
    robot = Robot()
    async with serving(robot.server) as served, served.connect() as client:
        await client.say(goal(50, feedback=False))
        for sec, canceled in [(1, 0), (2**40, 1)]:
            info = {"stamp": {"sec": sec, "nanosec": 5}}
            service = "fibonacci/_action/cancel_goal"
            await client.say(op="call_service", service=service, args=[info])
            answer = (await client.hear_until("service_response"))[-1]
            assert len(answer["values"]["goals_canceling"]) == canceled


@pytest.mark.parametrize(
    ("args", "why"),
    [
        ({"order": "x"}, 'goal.order must be a whole number, not "x"'),
        ({"order": 1.5}, "goal.order must be a whole number"),
        ({"order": 2**70}, "cannot be encoded"),
        ({"order": 1, "more": 2}, "more"),
        ({}, "goal.order is missing"),
        (None, "goal.order is missing"),
        ([1, 2], "the goal has 1 fields, and 2 are given"),
        (3, "Expected `object | array | null`, got `int`"),
    ],
)
async def test_wrong_arguments_are_answered_and_nothing_runs(
    args: Any, why: str, serving: Serving
) -> None:
    robot = Robot()
    async with serving(robot.server) as served, served.connect() as client:
        await client.say(goal(1, args=args))
        answer = await client.hear()
        assert answer == result(answer["values"], 0, ok=False, code=RejectionCode.UNREADABLE)
        assert why in answer["values"]
        await client.say(goal(1, args=[1], feedback=False))
        assert (await client.hear())["values"] == {"sequence": [1]}
        assert robot.runs == 1


async def test_an_action_that_is_not_served_is_told(serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(1, action="/dock"))
        answer = await client.hear()
        assert answer == result(answer["values"], 0, ok=False, action="/dock")
        assert "the action '/dock' is not served here" in answer["values"]
        service = "/dock/_action/cancel_goal"
        await client.say(op="call_service", service=service, id=1)
        answer = await client.hear()
        assert (answer["id"], answer["service"], answer["result"]) == (1, service, False)
        assert "is not served here" in answer["values"]


async def test_a_message_waits_for_the_large_one_before_it(serving: Serving) -> None:
    async with serving(Robot().server) as served, served.connect() as client:
        await client.say(goal(50, feedback=False, pad="x" * 100_000))
        await client.say(op="cancel_action_goal", id="g1", action="/fibonacci")
        assert await client.hear() == result({}, 5)
        await client.say(goal("x" * 100_000, feedback=False))
        await client.say(goal(3, feedback=False))
        wrong = await client.hear()
        assert (wrong["result"], wrong["status"]) == (False, 0)
        assert wrong["values"].startswith("goal.order must be a whole number, not")
        assert await client.hear() == result({"sequence": [3]})


async def test_a_goal_counts_though_its_client_closes_behind_it(serving: Serving) -> None:
    robot = Robot()
    async with serving(robot.server) as served:
        async with served.connect() as client:
            if isinstance(client, SocketClient):
                text = json.dumps(goal(3, feedback=False, pad="x" * 10_000))
                await client.send_events(TextMessage(data=text), CloseConnection(code=1000))
            else:
                await client.say(goal(3, feedback=False, pad="x" * 10_000))
                await client.leave()
            with anyio.fail_after(10):
                while not robot.runs:
                    await checkpoint()
