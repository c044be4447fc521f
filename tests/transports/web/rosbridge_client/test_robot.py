"""`rosbridge://` with a server that behaves as rosbridge_server does."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    CancelCode,
    ConnectionLost,
    GoalID,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    InvalidMessage,
    Limits,
    ProtocolError,
    Retry,
    ServerNotFound,
    TransportError,
    connect,
)
from fibaction.interfaces.ros_types import Int32, array
from fibaction.schema.payload import JsonCodec
from fibaction.words.goals import ActionPeers
from fibaction_transports.web import RosbridgeTransport
from fibaction_transports.web.rosbridge.client import endpoint as endpoint_module
from fibaction_transports.web.rosbridge.client import link_opener
from fibaction_transports.web.rosbridge.client.link_opener import UNKNOWN, DescribedTypes
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.support.matching import End
from tests.transports.hearing import Hearing
from tests.transports.web.rosbridge_client.servers import (
    NO_ANSWER,
    Peer,
    SilentServer,
    serving,
)

pytestmark = pytest.mark.anyio

FRAGMENT = {"op": "fragment", "id": 1, "data": "", "num": 0, "total": 1.0}


@asynccontextmanager
async def robot(
    kind: Any = None, settings: dict[str, Any] | None = None, **attributes: Any
) -> AsyncGenerator[tuple[Any, ActionClient[Goal, Feedback, Result]], None]:
    """A server, and a client of it; `attributes` are those of the server."""
    kinds = () if kind is None else (kind,)
    async with (
        serving(*kinds, **attributes) as server,
        connect(server.url, FIBONACCI, **(settings or {})) as client,
    ):
        yield server, client


@asynccontextmanager
async def open_goal(
    **settings: Any,
) -> AsyncGenerator[tuple[Peer, dict[str, Any], Any], None]:
    """A goal at a server that says what the test lets it say; its message, and what it has."""
    settings = {"accepted_after": 0, **settings}
    async with robot(SilentServer, settings) as (server, client):
        goal = await client.send_goal(Goal(3))
        peer = await server.peer()
        sent = await peer.hear("send_action_goal")
        yield peer, {"id": sent["id"], "action": sent["action"]}, goal


# What goes over the line


async def test_a_goal_is_sent_as_roslibjs_sends_it() -> None:
    async with open_goal() as (peer, _, goal):
        assert peer.texts == [
            {
                "op": "send_action_goal",
                "id": f"send_action_goal:/fibonacci:{goal.goal_id}",
                "action": "/fibonacci",
                "action_type": "arduinobot_msgs/action/Fibonacci",
                "args": {"order": 3},
                "feedback": True,
            }
        ]
        assert peer.request.subprotocols == []
        await goal.cancel()
        assert await peer.hear("cancel_action_goal") == {
            "op": "cancel_action_goal",
            "id": f"send_action_goal:/fibonacci:{goal.goal_id}",
            "action": "/fibonacci",
        }


async def test_a_server_can_be_asked_to_cancel_goals_whose_connection_is_lost() -> None:
    async with open_goal(cancel_on_disconnect=True) as (peer, _, goal):
        assert peer.texts[0]["cancel_on_disconnect"] is True
        await peer.stream.aclose()
        with pytest.raises(ConnectionLost, match="the robot cancels the goal if its rosbridge"):
            await goal.outcome()


async def test_the_type_of_an_action_without_one_is_asked_for_once() -> None:
    untyped = Action("fibonacci", goal=Goal, feedback=Feedback, result=Result)
    async with serving() as server, connect(server.url, untyped) as client:
        assert await client.call(Goal(1)) == Result([1])
        assert await client.call(Goal(2)) == Result([2])
        peer = await server.peer()
        assert [one["op"] for one in peer.texts] == ["call_service", *["send_action_goal"] * 2]


async def test_all_goals_are_canceled_up_to_a_time() -> None:
    async with robot() as (server, client):
        answer = await client.cancel_goals(before=5_000_000_006)
        peer = await server.peer()
        assert peer.texts[0]["service"] == "/fibonacci/_action/cancel_goal"
        stamp = {"sec": 5, "nanosec": 6}
        assert peer.texts[0]["args"] == {
            "goal_info": {"goal_id": {"uuid": [0] * 16}, "stamp": stamp}
        }
        (info,) = answer.goals_canceling
        assert (info.goal_id, info.stamp) == (bytes([7] * 16), 5_000_000_006)


# Goals


async def test_two_goals_of_a_robot_run_at_once() -> None:
    async with robot() as (_, client):
        one, other = await client.send_goal(Goal(50)), await client.send_goal(Goal(51))
        await other.cancel()
        assert await other.outcome() == End(GoalStatus.CANCELED, Result([51]))
        assert one.status is GoalStatus.EXECUTING
        await one.cancel()
        assert (await one.outcome()).result == Result([50])


async def test_a_goal_that_is_rejected_has_what_reason_there_is() -> None:
    async with robot() as (_, client):
        with pytest.raises(GoalRejected, match="Action goal was rejected"):
            await client.send_goal(Goal(-1))
    async with robot(SilentServer) as (server, client):
        async with anyio.create_task_group() as tasks:

            async def reject() -> None:
                peer = await server.peer()
                sent = await peer.hear("send_action_goal")
                await peer.say(op="action_result", id=sent["id"], values=None, result=False)

            tasks.start_soon(reject)
            with pytest.raises(GoalRejected, match="rosbridge gives no reason"):
                await client.send_goal(Goal(3))


async def test_an_action_without_a_server_is_not_found() -> None:
    other = Action.untyped(ActionInfo("other", "a/action/B"))
    unknown = Action.untyped(ActionInfo("other"))
    async with serving() as server, connect(server.url) as connection:
        with pytest.raises(ServerNotFound, match="'/other' is not served: No action server"):
            await connection.client(other).send_goal({"order": 3})
        with pytest.raises(GoalRejected, match="The type string is empty"):
            await connection.client(unknown).send_goal({"order": 3})


async def test_a_goal_that_a_server_leaves_without_an_answer_counts_as_accepted() -> None:
    async with robot(settings={"accepted_after": 0.01}, tells_rejections=False) as (_, client):
        goal = await client.send_goal(Goal(-1))
        assert goal.status is GoalStatus.ACCEPTED
        with pytest.raises(GoalTimeout):
            await client.call(Goal(-1), timeout=0.05)


async def test_a_goal_is_accepted_at_its_first_feedback() -> None:
    async with robot(settings={"accepted_after": 60}) as (_, client):
        goal = await client.send_goal(Goal(50))
        assert goal.status is GoalStatus.EXECUTING
        await goal.cancel()
        assert (await goal.outcome()).status is GoalStatus.CANCELED


async def test_a_rejection_that_comes_late_aborts_the_goal() -> None:
    async with open_goal() as (peer, names, goal):
        text = "Action goal was rejected"
        await peer.say(op="action_result", **names, values=text, status=0, result=False)
        assert await goal.outcome() == End(GoalStatus.ABORTED, reason=text)


async def test_a_result_without_a_status_is_a_success() -> None:
    async with robot(tells_status=False) as (_, client):
        assert await client.call(Goal(3)) == Result([3])


async def test_an_error_of_the_log_rejects_the_goal_that_it_names(log: Hearing) -> None:
    info = ActionInfo("fibonacci")
    async with serving(logs_to_client=True, has_rosapi=False) as server:
        async with connect(server.url) as connection:
            client = connection.client(Action.untyped(info))
            with pytest.raises(GoalRejected, match="The type string is empty"):
                await client.send_goal({"order": 3})
    await log.until("The type string is empty")


async def test_a_line_of_the_log_ends_no_goal_that_runs(log: Hearing) -> None:
    async with open_goal() as (peer, names, goal):
        await peer.say(op="status", id=names["id"], level="warning", msg="slow")
        await peer.say(op="status", id=names["id"], level="error", msg="no such cancel")
        await peer.say(op="status", level="error", msg="unknown operation")
        await peer.say(op="status", level="error", msg="unknown operation")
        await peer.say(op="action_result", **names, values={"sequence": [1]}, result=True)
        assert await goal.result() == Result([1])
    assert len([one for one in log.warnings if "unknown operation" in one]) == 1
    assert any("no such cancel" in one for one in log.warnings)


async def test_large_messages_come_in_fragments() -> None:
    async with robot(max_message_size=30) as (_, client):
        goal = await client.send_goal(Goal(3))
        assert [one.partial_sequence async for one in goal.feedback] == [[0, 3]]
        assert await goal.result() == Result([3])


async def test_numbers_that_json_does_not_have_become_nan() -> None:
    action = Action("drive", goal=float, feedback=list[float], result=dict[str, float | None])
    async with serving(SilentServer) as server:
        async with connect(server.url, action, accepted_after=0, answer_timeout=0) as client:
            with pytest.raises(ServerNotFound, match="has not answered a call of /rosapi/"):
                await client.send_goal(1.0)
    types = {"goal": float, "feedback": list[float], "result": dict[str, float | None]}
    typed: Action[Any, Any, Any] = Action("drive", **types, type_name="a/action/B")
    async with serving(SilentServer) as server:
        async with connect(server.url, typed, accepted_after=0) as client:
            goal = await client.send_goal(1.0)
            peer = await server.peer()
            sent = await peer.hear("send_action_goal")
            assert sent["args"] == {"data": 1.0}
            # Python's JSON has NaN; arrays of a fixed size come so.
            await peer.say(f'{{"op": "action_feedback", "id": "{sent["id"]}", "values": [NaN, 1]}}')
            await peer.say(op="action_feedback", id=sent["id"], values=[None, 2])
            await peer.say(op="action_result", id=sent["id"], values={"a": None, "b": 1})
            assert str([one async for one in goal.feedback]) == "[[nan, 1.0], [nan, 2.0]]"
            assert await goal.result() == {"a": None, "b": 1.0}


# What a server may not say


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ({"op": "action_feedback", "values": {"partial_sequence": "x"}}, "must be a list"),
        ({"op": "action_feedback", "values": None}, "feedback must be"),
        ({"op": "action_result", "values": {"sequence": 3}, "status": 4}, "must be a list"),
        ({"op": "action_result", "values": {"no": 3}, "status": 5}, "has no field"),
        ({"op": "action_result", "values": {}, "status": 2}, "ended with the status 2"),
        ({"op": "action_result", "values": {}, "status": 17}, "ended with the status 17"),
        ({"op": "action_result", "values": {}, "status": "x"}, "the action_result of the server"),
    ],
)
async def test_a_message_that_is_not_of_its_type_ends_its_goal_only(
    message: dict[str, Any], problem: str
) -> None:
    async with robot(SilentServer, {"accepted_after": 0}) as (server, client):
        goal = await client.send_goal(Goal(3))
        peer = await server.peer()
        names = {"id": (await peer.hear("send_action_goal"))["id"]}
        await peer.say({**names, **message})
        with pytest.raises(ProtocolError, match=problem):
            await goal.outcome()
        await peer.say({**names, **message})  # what comes behind the end is ignored
        await client.send_goal(Goal(4))
        await peer.hear("send_action_goal", 2)


@pytest.mark.parametrize(
    ("garbage", "code", "problem"),
    [
        ("{not JSON", 1007, "it sent a message that is not JSON"),
        ("x" * 2000, 1009, "exceeds the limit of 1024 bytes"),
        (b"\0\1", 1003, "binary message"),
        ('{"op":"fragment","id":1,"data":"x","num":3,"total":2.9}', 1007, "number that cannot be"),
        (json.dumps({**FRAGMENT, "data": json.dumps(FRAGMENT)}), 1007, "fragment within fragments"),
    ],
)
async def test_garbage_ends_the_connection_and_its_goals(
    garbage: str | bytes, code: int, problem: str
) -> None:
    async with open_goal(limits=Limits(frame=1024)) as (peer, _, goal):
        await peer.say(garbage)
        with pytest.raises(ProtocolError, match=f"rosbridge://.*{problem}.*; the goal may run on"):
            await goal.outcome()
        with anyio.fail_after(30):
            while peer.closed is None:
                await peer.news.wait()
        assert peer.closed == code


async def test_what_is_not_known_is_ignored(log: Hearing) -> None:
    async with open_goal() as (peer, names, goal):
        await peer.say(op="png", data="x")
        await peer.say([1, 2])
        await peer.say(op="action_feedback", id="another", values={})
        await peer.say(op="service_response", id="another", values={})
        await peer.say(op="service_response", **names, values={})
        await peer.say(op="action_result", **names, values={"sequence": []})
        assert await goal.result() == Result([])
    assert any("the operation 'png' of rosbridge is not known" in one for one in log.warnings)


# Lost connections


async def test_goals_of_a_lost_connection_end_and_the_next_one_is_sent_anew() -> None:
    async with robot(settings={"accepted_after": 0}) as (server, client):
        goal_id = GoalID.random()
        goal = await client.send_goal(Goal(50), goal_id=goal_id)
        peer = await server.peer()
        await peer.stream.aclose()
        with pytest.raises(ConnectionLost, match=r"closed .*may run on at the robot"):
            await goal.result()
        with pytest.raises(ConnectionLost):
            [one async for one in goal.feedback]
        assert (await goal.cancel()).return_code is CancelCode.GOAL_TERMINATED
        assert await client.call(Goal(3)) == Result([3])
        assert len(server.peers) == 2
        with pytest.raises(ConnectionLost):
            await client.send_goal(Goal(50), goal_id=goal_id)
        del goal


async def test_a_goal_is_not_sent_twice_by_a_retry() -> None:
    async with robot(SilentServer) as (server, client):
        errors: list[Exception] = []

        async def call() -> None:
            try:
                await client.call(Goal(50), retry=Retry(attempts=3, delay=0.001))
            except TransportError as exc:
                errors.append(exc)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(call)
            peer = await server.peer()
            await peer.hear("send_action_goal")
            await peer.stream.aclose()
        assert len(server.peers) == 1
        assert len(errors) == 1


async def test_a_server_that_answers_pings_lives_and_one_that_does_not_is_dead() -> None:
    async with open_goal(heartbeat=0.02) as (peer, _, goal):
        await peer.pinged(12)
        assert goal.status is GoalStatus.ACCEPTED
        peer.answers_pings = False
        with pytest.raises(ConnectionLost, match="has been silent for"):
            await goal.outcome()


@pytest.mark.parametrize("half", [b"", b"HTTP/1.1 101 Switching"])
async def test_a_server_that_does_not_accept_the_websocket_is_not_found(
    half: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_opener, "HANDSHAKE", 0.25)

    async def say_half(stream: Any) -> None:
        async with stream:
            if half:
                await stream.send(half)
            await anyio.sleep_forever()

    async with serving(SilentServer, say_half) as server:
        async with connect(server.url, FIBONACCI) as client:
            for _ in range(2):
                with pytest.raises(ServerNotFound, match=r"not accepted the WebSocket within 0.25"):
                    await client.send_goal(Goal(3))


async def test_a_host_that_does_not_answer_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    async def never(self: RosbridgeTransport) -> None:
        await anyio.sleep_forever()

    monkeypatch.setattr(link_opener, "HANDSHAKE", 0.01)
    monkeypatch.setattr(RosbridgeTransport, "open_line", never)
    async with connect("rosbridge://robot", FIBONACCI) as client:
        with pytest.raises(ServerNotFound, match=r"rosbridge://robot:9090 cannot be reached"):
            await client.send_goal(Goal(3))


async def test_a_server_that_reads_nothing_is_dead() -> None:
    class Deaf(SilentServer):
        async def handle(self, peer: Peer, message: Any) -> None:
            await anyio.sleep_forever()

    drive = Action.untyped(ActionInfo("drive", "a/action/B"))
    async with serving(Deaf) as server:
        async with connect(server.url, drive, accepted_after=0, heartbeat=0.02) as client:
            with pytest.raises(ConnectionLost, match=r"has been silent|has read nothing"):
                await client.send_goal("x")
                await client.send_goal("x" * 9_000_000)


# rosapi


def fields(schema: dict[str, Any]) -> Any:
    """The fields of a message, by its schema."""
    return schema["$defs"][schema["$ref"].rpartition("/")[2]]["properties"]


async def test_the_server_of_an_action_is_rosbridge_if_rosapi_lists_the_action() -> None:
    async with serving() as server, connect(server.url) as connection:
        assert await connection.peers("arm/pick") == ActionPeers((server.url,))
        assert await connection.peers("pick") == ActionPeers()


async def test_the_actions_of_a_robot_are_listed_with_their_schemas() -> None:
    async with serving() as server, connect(server.url) as connection:
        fibonacci_info, unknown, show = await connection.actions()
        assert (unknown.goal, unknown.feedback, unknown.result) == ({}, {}, {})
        assert fields(fibonacci_info.goal) == {
            "order": {**msgspec.json.schema(Int32), "default": 0}
        }
        assert fields(fibonacci_info.feedback) == {
            "partial_sequence": msgspec.json.schema(array(Int32))
        }
        assert fields(fibonacci_info.result) == {"sequence": msgspec.json.schema(array(Int32))}
        assert fields(show.feedback) == {}
        client = connection.client(Action.untyped(fibonacci_info))
        assert await client.call({"order": 3}) == {"sequence": [3]}
        template = JsonCodec(show.goal).complete({"turned": {}, "at": {"x": 1}})
        assert template == {
            "turned": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "at": {"x": 1, "y": 0.0, "z": 0.0},
        }


async def test_types_are_asked_for_once_in_a_connection() -> None:
    async with serving() as server, connect(server.url) as connection:
        for _ in range(2):
            found = await connection.actions()
            assert found[0].goal
        peer = await server.peer()
        asked = [one["service"] for one in peer.texts]
        assert asked.count("/rosapi/action_servers") == 2
        assert asked.count("/rosapi/interfaces") == 1
        assert len([one for one in asked if one.endswith("_details")]) == 6
        await peer.stream.aclose()
        with anyio.fail_after(30):
            while len(server.peers) < 2:
                with suppress(ConnectionLost):
                    await connection.actions()
        assert (await connection.actions())[0].goal
        assert (await server.peer(2)).texts[-1]["service"] != "/rosapi/interfaces"


@pytest.mark.parametrize("part", ["goal", "feedback", "result"])
@pytest.mark.parametrize("answer", [{"typedefs": 3}, {}, "no such type", {"typedefs": []}])
async def test_a_message_that_rosapi_does_not_describe_has_no_schema(
    part: str, answer: Any
) -> None:
    answers = {f"/rosapi/action_{part}_details": answer}
    async with serving(answers=answers) as server, connect(server.url) as connection:
        info, *_ = await connection.actions()
        schemas = {"goal": info.goal, "feedback": info.feedback, "result": info.result}
        assert [name for name, found in schemas.items() if not found] == [part]
        assert await connection.client(Action.untyped(info)).call({"order": 3}) == {"sequence": [3]}


async def test_a_rosapi_that_knows_no_types_leaves_the_actions_without_schemas() -> None:
    async with serving(describes_types=False) as server, connect(server.url) as connection:
        info, *_ = await connection.actions()
        assert info == ActionInfo("fibonacci", FIBONACCI.type_name)
        assert await connection.client(Action.untyped(info)).call({"order": 3}) == {"sequence": [3]}


async def test_a_rosapi_that_ends_while_it_is_asked_is_not_waited_for_again() -> None:
    answers = {"/rosapi/action_goal_details": NO_ANSWER}
    async with serving(answers=answers) as server:
        async with connect(server.url, answer_timeout=0.5) as connection:
            infos = await connection.actions()
            assert [info.goal for info in infos] == [{}, {}, {}]
            peer = await server.peer()
            asked = [one["service"] for one in peer.texts]
            assert asked.count("/rosapi/action_goal_details") == 1
            assert "/rosapi/action_result_details" not in asked


async def test_rosapi_is_not_asked_for_a_type_that_it_does_not_know() -> None:
    answers = {"/rosapi/interfaces": {"interfaces": [FIBONACCI.type_name]}}
    async with serving(answers=answers) as server, connect(server.url) as connection:
        infos = await connection.actions()
        assert [bool(info.goal) for info in infos] == [True, False, False]
        peer = await server.peer()
        asked = [one["args"]["type"] for one in peer.texts if one["service"].endswith("_details")]
        assert set(asked) == {FIBONACCI.type_name}


async def test_rosapi_is_not_asked_for_types_if_that_is_set() -> None:
    async with serving() as server, connect(server.url, schemas=False) as connection:
        info, *_ = await connection.actions()
        assert info == ActionInfo("fibonacci", FIBONACCI.type_name)
        async with connect(f"{server.url}?schemas=false") as other:
            assert await other.actions() == await connection.actions()
        asked = [one["service"] for one in (await server.peer()).texts]
        assert set(asked) == {"/rosapi/action_servers", "/rosapi/action_type"}


async def test_a_server_that_always_has_new_types_is_asked_again_for_the_oldest() -> None:
    asked: list[str] = []

    async def call(service: str, args: dict[str, Any]) -> Any:
        if service == "/rosapi/action_goal_details":
            asked.append(args["type"])
        return {"interfaces": ["a", "b", "c"], "typedefs": []}

    types = DescribedTypes(call, 2)
    for name in ("a", "b", "a", "c", "b", "a"):
        assert await types.schemas_of(name) == UNKNOWN
    assert asked == ["a", "b", "c", "a"]
    assert len(types._found) == 2


async def test_bytes_cross_both_ways_by_the_schemas_of_a_robot() -> None:
    async with serving() as server, connect(server.url) as connection:
        *_, info = await connection.actions()
        client = connection.client(Action.untyped(info))
        # Text of base64 is what a form or a file has.
        goal = JsonCodec(info.goal).complete({"pixels": "AAH/", "mask": [1, 2], "few": [3]})
        assert (goal["pixels"], goal["mask"]) == (b"\0\1\xff", b"\1\2")
        assert await client.call(goal) == {"pixels": b"\0\1\xff", "few": b"\3"}
        sent = await (await server.peer()).hear("send_action_goal")
        assert (sent["args"]["pixels"], sent["args"]["mask"]) == ([0, 1, 255], [1, 2])
        many = bytes(range(256)) * 1000
        assert (await client.call({"pixels": many}))["pixels"] == many
        with pytest.raises(InvalidMessage, match="as JSON, and rosbridge takes"):
            await client.call({"pixels": bytes(8_000_000)})


async def test_without_rosapi_there_is_no_list() -> None:
    async with serving(has_rosapi=False) as server, connect(server.url) as connection:
        with pytest.raises(TransportError, match=r"start rosapi next to rosbridge.*does not exist"):
            await connection.actions()
        assert await connection.client(FIBONACCI).call(Goal(3)) == Result([3])


@pytest.mark.parametrize(
    ("answer", "error", "problem"),
    [
        ({"op": "service_response", "values": {}}, ProtocolError, "invalid answer of rosapi"),
        ({"op": "service_response", "values": 3, "result": False}, TransportError, "no reason"),
        (
            {"op": "service_response", "result": "x"},
            ProtocolError,
            "service_response of the server",
        ),
        ({"op": "status", "level": "error", "msg": "no such service"}, TransportError, "no such"),
    ],
)
async def test_a_call_that_fails_says_why(
    answer: dict[str, Any], error: type[Exception], problem: str
) -> None:
    class Answering(SilentServer):
        async def handle(self, peer: Peer, message: Any) -> None:
            await peer.say(op="status", id=message["id"], level="info", msg="a call")
            await peer.say({"id": message["id"], **answer})

    async with serving(Answering) as server, connect(server.url) as connection:
        with pytest.raises(error, match=problem):
            await connection.actions()


@pytest.mark.parametrize("values", [None, {}, {"return_code": 9}, {"return_code": 0}])
async def test_an_answer_to_a_cancel_that_is_not_one_is_an_error(values: Any) -> None:
    answers = {"/fibonacci/_action/cancel_goal": values}
    async with robot(answers=answers) as (_, client):
        with pytest.raises(ProtocolError, match="invalid answer to a cancel"):
            await client.cancel_goals()


async def test_an_action_is_waited_for_until_rosapi_lists_it(
    log: Hearing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(endpoint_module, "LOOK_PAUSE", 0.01)
    said: list[Any] = ["no rosapi", "no rosapi", [], None, ["/fibonacci"]]

    class Starting(SilentServer):
        async def handle(self, peer: Peer, message: Any) -> None:
            values = said.pop(0)
            if values is None:
                await peer.stream.aclose()
                return
            is_there = isinstance(values, list)
            answer = {"action_servers": values} if is_there else values
            members = {"op": "service_response", "values": answer, "result": is_there}
            await peer.say({**members, "id": message["id"]})

    async with robot(Starting) as (server, client):
        await client.wait_for_server(10)
        assert (said, len(server.peers)) == ([], 2)
    assert len([one for one in log.warnings if "start rosapi" in one]) == 1


async def test_a_closed_connection_is_not_waited_for() -> None:
    connection = await connect("rosbridge://127.0.0.1:1", FIBONACCI)
    await connection.aclose()
    with pytest.raises(ConnectionLost, match="was closed here"):
        await connection.endpoint.wait_for_server()


# Limits of rosbridge


async def test_what_rosbridge_cannot_do_is_an_error_that_says_so() -> None:
    async with robot() as (_, client):
        other = GoalID.random()
        with pytest.raises(TransportError, match=r"rosbridge cannot follow goal .*not a goal of"):
            await client.attach(other)
        with pytest.raises(TransportError, match="rosbridge cannot cancel goal"):
            await client.cancel_goals(other)
        with pytest.raises(TransportError, match="cannot list the goals of 'fibonacci'"):
            await client.goals()
        assert client.endpoint.info.name == "fibonacci"
        goal = await client.send_goal(Goal(50))
        with pytest.raises(TransportError, match="rosbridge cannot cancel goal"):
            await client.cancel_goals(goal.goal_id, before=goal.stamp)


async def test_schemas_that_cannot_be_used_are_an_error() -> None:
    async with connect("rosbridge://robot") as connection:
        with pytest.raises(TransportError, match="the action 'x' cannot be used"):
            connection.endpoint(ActionInfo("x", feedback={"$ref": "http://a"}))


async def test_a_connection_remembers_a_limited_number_of_goals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(link_opener, "MOST_SENT", 2)
    async with robot() as (_, client):
        ids = [GoalID.random() for _ in range(3)]
        for goal_id in ids:
            goal = await client.send_goal(Goal(3), goal_id=goal_id)
            await goal.result()
        del goal
        with pytest.raises(TransportError, match="rosbridge would run it a second time"):
            await client.send_goal(Goal(3), goal_id=ids[1])
        await client.send_goal(Goal(3), goal_id=ids[0])
