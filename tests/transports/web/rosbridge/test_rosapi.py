"""The services of rosapi, as rosbridge clients call them."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fibaction import Action, ActionServer
from fibaction.border.abc import ForwardingEndpoint
from fibaction.interfaces.ros_types import Int32, UInt8, UInt64, array, struct
from fibaction.types.action import ActionInfo
from tests.support.fibonacci import fibonacci
from tests.transports.tcp.servers import new_server
from tests.transports.web.rosbridge.clients import RosbridgeClient, Serving
from tests.transports.web.rosbridge.robot import TYPE, goal

pytestmark = pytest.mark.anyio


def made(name: str, *fields: tuple[str, Any, Any]) -> Any:
    return struct(name, fields, module="m", doc=name, constants={})


POINT = made("Point", ("x", float, 0.0))
MOVE_GOAL = made(
    "Move_Goal",
    ("target", POINT, {}),
    ("path", array(POINT), []),
    ("uuid", array(UInt8, size=16), bytes(16)),
    ("joint", Int32, 0),
    ("turns", UInt64, 0),
    ("limits", array(float, size=2), [0.0, 0.0]),
    ("name", str, ""),
    ("fast", bool, False),
)


class Anything(msgspec.Struct):
    either: int | str
    more: Any = None
    pairs: list[tuple[int, str]] = []


class Point(msgspec.Struct):
    x: float
    y: float = 0.0


class Nested(msgspec.Struct):
    inner: list[Nested] = []


MOVE = Action(
    "/arm/move", goal=MOVE_GOAL, feedback=Anything, result=Nested, type_name="arm_msgs/action/Move"
)


def servers() -> list[ActionServer[Any, Any, Any]]:
    untyped = Action("idle", goal=int, feedback=str, result=float)
    return [
        new_server(),
        ActionServer(MOVE, fibonacci),
        ActionServer(untyped, fibonacci),
    ]  # they do not run


async def call(client: RosbridgeClient, service: str, args: Any = None) -> Any:
    await client.say(op="call_service", id="c", service=service, args=args)
    answer = await client.hear()
    expected = {"op": "service_response", "id": "c", "service": service}
    assert {name: answer[name] for name in expected} == expected
    assert set(answer) == {*expected, "values", "result"}
    return answer["values"] if answer["result"] else str(answer["values"])


async def test_the_topics_of_actions_are_listed_with_their_types(serving: Serving) -> None:
    status = "action_msgs/msg/GoalStatusArray"
    async with serving(*servers()) as served, served.connect() as client:
        types = {
            "/fibonacci/_action/feedback": f"{TYPE}_FeedbackMessage",
            "/fibonacci/_action/status": status,
            "/arm/move/_action/feedback": "arm_msgs/action/Move_FeedbackMessage",
            "/arm/move/_action/status": status,
            "/idle/_action/feedback": "",
            "/idle/_action/status": status,
        }
        answer = await call(client, "/rosapi/topics")
        assert answer == {"topics": list(types), "types": list(types.values())}
        for topic in ("/fibonacci/_action/feedback", "fibonacci/_action/feedback"):
            kind = await call(client, "/rosapi/topic_type", {"topic": topic})
            assert kind == {"type": f"{TYPE}_FeedbackMessage"}
        assert await call(client, "/rosapi/topic_type", ["/chatter"]) == {"type": ""}
        found = await call(client, "/rosapi/topics_for_type", {"type": status})
        assert found == {"topics": [topic for topic, kind in types.items() if kind == status]}


@pytest.mark.parametrize("slash", ["/", ""])
async def test_the_actions_are_listed(slash: str, serving: Serving) -> None:
    async with serving(*servers()) as served, served.connect() as client:
        assert await call(client, f"{slash}rosapi/action_servers", {}) == {
            "action_servers": ["/fibonacci", "/arm/move", "/idle"]
        }
        for name in ("fibonacci", "/fibonacci"):
            found = await call(client, f"{slash}rosapi/action_type", {"action": name})
            assert found == {"type": TYPE}
        for args in (["arm/move"], {"action": "/arm/move"}):
            found = await call(client, f"{slash}rosapi/action_type", args)
            assert found == {"type": "arm_msgs/action/Move"}
        assert await call(client, "rosapi/action_type", {"action": "/dock"}) == {"type": ""}
        assert await call(client, "rosapi/action_type", {"action": "idle"}) == {"type": ""}


async def test_other_tools_find_what_they_ask_for(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(*servers()) as served, served.connect() as client:
        found = await call(client, "/rosapi/interfaces")
        assert found == {"interfaces": ["arduinobot_msgs/action/Fibonacci", "arm_msgs/action/Move"]}
        services = (await call(client, "/rosapi/services"))["services"]
        assert "/arm/move/_action/cancel_goal" in services
        assert "/rosapi/action_goal_details" in services
        monkeypatch.setenv("ROS_DISTRO", "kilted")
        version = await call(client, "/rosapi/get_ros_version")
        assert version == {"version": 2, "distro": "kilted"}
        monkeypatch.delenv("ROS_DISTRO")
        assert (await call(client, "/rosapi/get_ros_version"))["distro"] == ""


async def test_types_are_described(serving: Serving) -> None:
    async with serving(*servers()) as served, served.connect() as client:
        for name in ("arm_msgs/action/Move", "arm_msgs/Move"):
            found = await call(client, "/rosapi/action_goal_details", {"type": name})
            move, point = found["typedefs"]
            assert point["type"] == "Point"
            assert point["fieldtypes"] == ["float64"]
            assert point["examples"] == ["0.0"]
        assert move["type"] == "arm_msgs/Move_Goal"
        rows = zip(
            move["fieldnames"],
            move["fieldtypes"],
            move["fieldarraylen"],
            move["examples"],
            strict=True,
        )
        assert [tuple(row) for row in rows] == [
            ("target", "Point", -1, "{}"),
            ("path", "Point", 0, "[]"),
            ("uuid", "uint8", 0, "[]"),
            ("joint", "int32", -1, "0"),
            ("turns", "uint64", -1, "0"),
            ("limits", "float64", 2, "[]"),
            ("name", "string", -1, ""),
            ("fast", "boolean", -1, "False"),
        ]
        assert (move["constnames"], move["constvalues"]) == ([], [])
        assert "required" not in move


async def test_the_defaults_of_fields_are_told_and_the_fields_without_one(serving: Serving) -> None:
    goal = made("Turn_Goal", ("angle", float, -0.5), ("fast", bool, True), ("name", str, "arm"))
    turn = Action("turn", goal=goal, feedback=Point, result=float, type_name="arm_msgs/action/Turn")
    async with serving(ActionServer(turn, fibonacci)) as served, served.connect() as client:
        details = {"type": "arm_msgs/action/Turn"}
        (found,) = (await call(client, "/rosapi/action_goal_details", details))["typedefs"]
        assert found["examples"] == ["-0.5", "True", "arm"]
        (found,) = (await call(client, "/rosapi/action_feedback_details", details))["typedefs"]
        assert (found["fieldnames"], found["required"]) == (["x", "y"], ["x"])
        # A value that is not an object is in a field `data`.
        (found,) = (await call(client, "/rosapi/action_result_details", details))["typedefs"]
        assert (found["type"], found["fieldnames"]) == ("arm_msgs/Turn_Result", ["data"])
        assert (found["fieldtypes"], found["required"]) == (["float64"], ["data"])


async def test_types_that_ros_does_not_have_are_described_as_far_as_they_go(
    serving: Serving,
) -> None:
    async with serving(*servers()) as served, served.connect() as client:
        details = {"type": "arm_msgs/action/Move"}
        (found,) = (await call(client, "/rosapi/action_feedback_details", details))["typedefs"]
        assert found["type"] == "arm_msgs/Move_Feedback"
        assert found["fieldtypes"] == ["any", "any", "any"]
        result = (await call(client, "/rosapi/action_result_details", details))["typedefs"]
        assert [one["type"] for one in result] == ["arm_msgs/Move_Result", "Nested"]
        assert result[1]["fieldtypes"] == ["Nested"]


@pytest.mark.parametrize(
    ("service", "args", "why"),
    [
        ("/rosapi/action_type", {}, "the argument action must be text"),
        ("/rosapi/action_type", [], "the argument action must be text"),
        ("/rosapi/action_type", [5], "the argument action must be text"),
        ("/rosapi/action_goal_details", {"type": 1}, "the argument type must be text"),
        ("/rosapi/action_goal_details", {"type": ""}, "the action type '' is not served here"),
        ("/rosapi/action_goal_details", {"type": "a/b"}, "'a/b' is not served here"),
        ("/rosapi/topic_type", None, "the argument topic must be text"),
        ("/rosapi/nodes", None, "the service '/rosapi/nodes' is not served here"),
        ("/add_two_ints", None, "the service '/add_two_ints' is not served here"),
        ("/fibonacci/_action/get_result", None, "is not served here"),
        ("/fibonacci/_action/cancel_goal", [{"goal_id": {"uuid": "??"}}], "must have 16 bytes"),
        ("/fibonacci/_action/cancel_goal", [{"goal_id": {"uuid": [1]}}], "must have 16 bytes"),
        ("/fibonacci/_action/cancel_goal", [{"goal_id": {"uuid": ["a"]}}], "have 16 bytes"),
        ("/fibonacci/_action/cancel_goal", [{"goal_id": {"uuid": 5}}], "must have 16 bytes"),
        ("/fibonacci/_action/cancel_goal", [{"stamp": {"sec": "now"}}], "must have whole numbers"),
        ("/fibonacci/_action/cancel_goal", [{"stamp": {"sec": -1}}], "must have whole numbers"),
    ],
)
async def test_a_call_that_cannot_be_answered_is_told_why(
    service: str, args: Any, why: str, serving: Serving
) -> None:
    async with serving(new_server()) as served, served.connect() as client:
        assert why in await call(client, service, args)


class Described(ForwardingEndpoint):
    """An endpoint behind a gateway, whose server describes itself as a test wants."""

    def __init__(self, schema: Any) -> None:
        super().__init__(new_server())
        self._info = ActionInfo("fibonacci", TYPE, schema, schema, schema)

    @property
    def info(self) -> ActionInfo:
        return self._info


@pytest.mark.parametrize("schema", [{"$ref": "https://x"}, {"$ref": "#/no"}, {"type": 5}])
async def test_a_schema_that_cannot_be_used_is_told(schema: Any, serving: Serving) -> None:
    async with serving(Described(schema)) as served, served.connect() as client:
        why = await call(client, "/rosapi/action_goal_details", {"type": TYPE})
        assert why.startswith("the schema of the goal ")
        await client.say(goal(1))
        assert (await client.hear())["values"].startswith("the schema of the goal ")
