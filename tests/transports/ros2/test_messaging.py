"""Topics, services, parameters and actions of one node, over DDS and over Zenoh."""

from __future__ import annotations

import random
import re
import uuid
from array import array
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any

import anyio
import msgspec
import pytest

from fibaction import (
    ActionServer,
    ConnectionLost,
    InvalidURL,
    ProtocolError,
    TransportError,
    connect,
    serve,
)
from fibaction.border.event_loop import Background
from fibaction.interfaces.files import read_interface, read_message
from fibaction.interfaces.packages import SearchPath
from fibaction.interfaces.source import types_source
from fibaction.interfaces.structs import structs_of
from fibaction_transports.ros2 import Node, Service, Subscription, open_node
from fibaction_transports.ros2.messaging import node as messaging_node
from fibaction_transports.ros2.messaging import services, topics, transforms
from fibaction_transports.ros2.messaging.node import topic_values
from fibaction_transports.ros2.node.own_parameters import written
from fibaction_transports.ros2.node.ros_node import RosClock, TypeVersion
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsNode, DdsSettings
from fibaction_transports.ros2.on_dds.services import DdsCaller
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.messages import file_types
from fibaction_transports.rtps.endpoints.reader_proxy import SILENCE
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]

STRING, BOOL = "std_msgs/msg/String", "std_srvs/srv/SetBool"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"


@pytest.fixture(params=["dds://", "zenoh:///"])
def scheme(request: pytest.FixtureRequest) -> Any:
    return request.param


@asynccontextmanager
async def two_nodes(scheme: str) -> AsyncGenerator[tuple[Node, Node], None]:
    namespace = f"/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            open_node(f"{scheme}robot", namespace=namespace, arguments=[]) as robot,
            open_node(f"{scheme}planner", namespace=namespace, arguments=[]) as planner,
        ):
            yield robot, planner


async def test_messages_arrive_in_order_with_the_fields_of_ros(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        assert robot.name.endswith("/robot")
        odometry = planner.subscribe("odom", ODOMETRY)
        publisher = robot.publisher("odom", ODOMETRY)
        await publisher.wait_for_reader(PATIENCE)
        assert publisher.topic == odometry.topic == robot.full_name("odom")
        assert odometry.latest is None
        for x in (1.0, 2.0, 3.0):
            await publisher.publish({"pose": {"pose": {"position": {"x": x}}}})
        found = [(await odometry.next()).pose.pose for _ in range(3)]
        assert [(pose.position.x, pose.orientation.w) for pose in found] == [
            (1.0, 1.0),
            (2.0, 1.0),
            (3.0, 1.0),
        ]
        assert odometry.latest is not None
        assert odometry.latest.pose.pose.position.x == 3.0
        assert (odometry.publisher_count(), publisher.reader_count()) == (1, 1)
        await publisher.publish(odometry.latest)
        assert await odometry.next() == odometry.latest


async def test_a_loop_that_publishes_lets_others_have_their_turns(scheme: str) -> None:
    seen = anyio.Event()

    async def other() -> None:
        seen.set()

    async with two_nodes(scheme) as (robot, _), anyio.create_task_group() as tasks:
        publisher = robot.publisher("odom", STRING)
        tasks.start_soon(other)
        for _ in range(1_000_000):
            await publisher.publish({"data": "again"})
            if seen.is_set():
                break
        assert seen.is_set()


async def test_a_loop_that_works_between_its_messages_lets_others_have_their_turns(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, turns = 0.0, 0
    monkeypatch.setattr(topics, "perf_counter", lambda: now)

    async def other() -> None:
        nonlocal turns
        while True:
            turns += 1
            await anyio.lowlevel.checkpoint()

    async with two_nodes(scheme) as (robot, _), anyio.create_task_group() as tasks:
        publisher = robot.publisher("image", STRING)
        tasks.start_soon(other)
        for _ in range(10):
            now += 0.02  # the work
            await publisher.publish({"data": "an image"})
        assert turns >= 9
        tasks.cancel_scope.cancel()


async def test_large_values_are_published_without_a_copy_and_unusual_ones_are_taken_too(
    scheme: str,
) -> None:
    octets = bytes(1_000)
    async with two_nodes(scheme) as (robot, _):
        publisher = robot.publisher("image", "std_msgs/msg/UInt8MultiArray")
        assert publisher.message({"data": octets}).data is octets
        assert bytes(publisher.message({"data": array("B", octets)}).data) == octets
        with pytest.raises(ValueError, match="unknown field `dada`"):
            publisher.message({"data": octets, "dada": 1})


async def test_nothing_is_kept_of_publishers_that_have_gone(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        heard: Any = planner.subscribe("chatter", STRING)
        with robot.publisher("chatter", STRING) as publisher:
            await publisher.wait_for_reader(PATIENCE)
            await publisher.publish({})
            await heard.next()
            assert len(heard._part._numbers._last) == 1
        await until(lambda: not heard._part._numbers._last)


async def test_a_slow_reader_gets_the_newest_messages_and_those_it_missed_are_counted(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    async with two_nodes(scheme) as (robot, planner):
        heard = planner.subscribe("chatter", STRING, depth=2)
        newest = planner.subscribe("chatter", STRING, depth=1)
        publisher = robot.publisher("chatter", STRING)
        await until(lambda: publisher.reader_count() == 2)
        for number in range(5):
            await publisher.publish({"data": str(number)})
        await until(lambda: heard.latest is not None and heard.latest.data == "4")
        assert [(await heard.next()).data for _ in range(2)] == ["3", "4"]
        assert heard.dropped == 3
        assert (newest.dropped, (await newest.next()).data) == (0, "4")
        assert "/chatter was dropped (2 so far): newer ones came before it was read" in caplog.text


class Stray(msgspec.Struct):
    a: int = 0


class Foreign(msgspec.Struct):
    __ros_type__ = STRING
    text: str = ""


class Narrow(msgspec.Struct):
    probes: Annotated[list[Any], msgspec.Meta(max_length=0)] = []


async def test_wrong_types_names_and_fields_are_told_in_a_sentence(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, _):
        publisher = robot.publisher("goal", "geometry_msgs/msg/Twist")
        for wrong, text in (
            ({"linear": {"x": "fast"}}, r"Expected `float`, got `str` - at `\$.linear.x`"),
            ({"speed": 1.0}, "unknown field `speed`"),
            (Stray(), "unknown field `a`"),
            (10**30, "more than 64 bits"),
        ):
            with pytest.raises(ValueError, match=rf"/goal: not a geometry_msgs/Twist: .*{text}"):
                await publisher.publish(wrong)
        with pytest.raises(TransportError, match="geometry_msgs/msg/Twisted cannot be used"):
            robot.subscribe("goal", "geometry_msgs/msg/Twisted")
        with pytest.raises(TransportError, match="expected a type like 'std_msgs/msg/String'"):
            robot.subscribe("goal", "geometry_msgs/Twist")
        with pytest.raises(TransportError, match=r"expected std_srvs/srv/Set.srv in .*found none"):
            await robot.call("reset", "std_srvs/srv/Set")
        with pytest.raises(TypeError, match="is not made from a type of ROS"):
            robot.subscribe("goal", Stray)
        with pytest.raises(TypeError, match="does not have the fields of ROS"):
            robot.subscribe("goal", Foreign)
        none: Any = None
        with pytest.raises(TypeError, match="None is not made from a type of ROS"):
            robot.subscribe("goal", none)
        with pytest.raises(TypeError, match="None is not a type of services: give it by its name"):
            await robot.call("reset", none)
        for end in (robot.publisher, robot.subscribe, robot.latest):
            with pytest.raises(TypeError, match=r"qos is a text .*, and not \['reliable'\]"):
                end("goal", STRING, qos=["reliable"])  # type: ignore[call-overload]  # that is the test
        with pytest.raises(TypeError, match="is not made from a type of ROS"):
            robot.latest("goal", [STRING])  # type: ignore[call-overload]  # that is the test
        with pytest.raises(TypeError, match="is not a type of services"):
            await robot.call("reset", [BOOL])  # type: ignore[call-overload]  # that is the test
        with pytest.raises(ValueError, match="depth must be at least 1"):
            robot.subscribe("goal", STRING, depth=0)
        for name, problem in (
            (
                "{robot}/goal",
                "'{robot}/goal' is not a valid name in ROS: {robot} is not {node}",
            ),
            ("goal/", "it has names of letters, digits and _ between slashes"),
            ("/" + "a" * 247, "it has 248 characters of 247 at most"),
        ):
            with pytest.raises(TransportError, match=re.escape(problem)):
                robot.subscribe(name, STRING)


async def test_a_publisher_that_keeps_all_waits_for_a_slow_reader_and_for_no_one_else(
    scheme: str,
) -> None:
    async with two_nodes(scheme) as (robot, planner):
        slow = planner.subscribe("chatter", STRING, qos="keep_all", depth=4)
        quick = planner.subscribe("chatter", STRING, depth=500)
        publisher = robot.publisher("chatter", STRING, qos="keep_all", depth=8)
        other = robot.publisher("chatter", STRING)
        await until(lambda: publisher.reader_count() == 2)
        await until(lambda: slow.publisher_count() == 2)
        reader, sent = quick, 0
        if scheme == "dds://":  # over Zenoh, a publisher waits for the network alone
            with pytest.raises(TimeoutError, match=r"readers have taken too little of .*/chatter"):
                while True:
                    await publisher.publish({"data": str(sent)}, timeout=0.2)
                    sent += 1
            assert 8 <= sent < 300
            await until(lambda: quick.latest.data == str(sent - 1) if quick.latest else False)
            await other.publish({"data": "other"})
            await until(lambda: quick.latest.data == "other" if quick.latest else False)
            reader = slow
        async with anyio.create_task_group() as tasks:

            async def publish() -> None:
                for number in range(sent, 400):
                    await publisher.publish({"data": str(number)}, timeout=PATIENCE)

            tasks.start_soon(publish)
            found: list[str] = []
            while len(found) < 400:
                text = (await reader.next(PATIENCE)).data
                found += [text] * (text != "other")
        assert found == [str(number) for number in range(400)]
        assert (reader.dropped, quick.dropped) == (0, 0)


async def test_a_reader_that_keeps_all_is_bounded_beside_a_publisher_that_does_not_wait(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "LATE", 5)
    async with two_nodes(scheme) as (robot, _):
        slow = robot.subscribe("chatter", STRING, qos="keep_all", depth=4)
        publisher = robot.publisher("chatter", STRING)
        await publisher.wait_for_reader(PATIENCE)
        for number in range(20):
            await publisher.publish({"data": str(number)})
        await until(lambda: slow.latest.data == "19" if slow.latest else False)
        assert len(slow._queue) <= 9
        assert slow.dropped == 20 - len(slow._queue)


async def test_a_publisher_that_waits_learns_that_it_was_closed(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, _):
        publisher = robot.publisher("chatter", STRING, qos="keep_all")
        publisher._part.has_room = lambda: publisher._is_closed  # type: ignore[method-assign]  # it is full
        async with anyio.create_task_group() as tasks:

            async def is_told() -> None:
                with pytest.raises(anyio.ClosedResourceError):
                    await publisher.publish({})

            tasks.start_soon(is_told)
            await anyio.wait_all_tasks_blocked()
            publisher.close()


async def test_the_newest_message_of_a_topic_and_any_topic_are_read_without_a_subscription(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with two_nodes(scheme) as (robot, planner):
        weak = robot.publisher("map", STRING, qos="best_effort")
        assert planner.latest("map", STRING, qos="sensor_data") is None
        await weak.wait_for_reader(PATIENCE)
        found = None
        # Until the reader knows the publisher, it takes nothing of it; and the last may come later.
        while found is None or found.data != "c":
            for text in ("a", "b", "c"):
                await weak.publish({"data": text})
            await anyio.sleep(0.01)
            found = planner.latest("map", STRING, qos="sensor_data")
        assert "dropped" not in caplog.text
        topics = await planner.settled(lambda view: dict(view.topics()))
        assert topics[weak.topic] == STRING
        robot.subscribe("wanted", STRING)  # a topic that no one publishes
        await until(lambda: planner.topics().get(f"{weak.topic.removesuffix('map')}wanted"))
        assert (await planner.follow("wanted")).publisher_count() == 0
        with robot.serve_service("reset", BOOL, lambda request: None):
            reset = robot.full_name("reset")
            await until(lambda: dict(planner._ros.services()).get(reset) == BOOL)
        with await planner.follow("map", timeout=PATIENCE) as any_of_it:
            await until(lambda: weak.reader_count() == 2)
            await until(any_of_it.publisher_count)
            await weak.publish({"data": "d"})
            assert (await any_of_it.next(PATIENCE)).data == "d"
        latched = robot.publisher("latched", STRING, qos="transient_local")
        await latched.publish({"data": "kept"})
        async with topic_values(
            f"{scheme}console", latched.topic, arguments=[], timeout=PATIENCE
        ) as values:
            assert await anext(values) == {"data": "kept"}


async def test_clients_of_services_give_way_that_no_one_uses(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messaging_node, "MOST_CALLERS", 2)

    async def never(request: Any) -> None:
        await anyio.sleep_forever()

    async with two_nodes(scheme) as (robot, planner):
        with robot.serve_service("slow", BOOL, never):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(planner.call, "slow", BOOL)
                await anyio.wait_all_tasks_blocked()
                for number in range(4):
                    with robot.serve_service(f"s{number}", BOOL, lambda request: None):
                        await planner.call(f"s{number}", BOOL, timeout=PATIENCE)
                used = [name.rpartition("/")[2] for name, _ in planner._callers]
                assert used == ["slow", "s3"]
                tasks.cancel_scope.cancel()


async def test_a_closed_end_is_gone_from_the_graph_and_says_so(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        with planner.subscribe("chatter", STRING) as heard:
            with robot.publisher("chatter", STRING) as publisher:
                await publisher.wait_for_reader(PATIENCE)
                await publisher.publish({"data": "last"})
                await heard.next()
                await until(heard.publisher_count)
            await until(lambda: not heard.publisher_count())
            publisher.close()
            with pytest.raises(anyio.ClosedResourceError):
                await publisher.publish({"data": "later"})
        assert [message async for message in heard] == []
        with pytest.raises(anyio.ClosedResourceError):
            await heard.next()
        read = anyio.Event()

        async def read_all(messages: Subscription[Any]) -> None:
            assert [message async for message in messages] == []
            read.set()

        async with anyio.create_task_group() as tasks:
            silent = planner.subscribe("chatter", STRING)
            tasks.start_soon(read_all, silent)
            await anyio.wait_all_tasks_blocked()
            for _ in range(2):
                silent.close()
            await read.wait()


async def test_calls_for_one_message_share_a_subscription(scheme: str) -> None:
    text_type = structs_of([read_message(STRING, SearchPath((), ()))])["String"]
    async with two_nodes(scheme) as (robot, planner):
        odom = robot.publisher("odom", STRING)
        kept = robot.publisher("map", STRING, qos="transient_local")
        await kept.publish({"data": "kept"})
        for _ in range(2):
            found = await planner.next("map", STRING, qos="transient_local", timeout=PATIENCE)
            assert found.data == "kept"
        await until(lambda: kept.reader_count() > 0)  # over Zenoh it may come after its message
        heard: list[str] = []

        async def hear(type_: Any) -> None:
            heard.append((await planner.next("odom", type_, timeout=PATIENCE)).data)

        for text in ("a", "b"):
            async with anyio.create_task_group() as tasks:
                for type_ in (STRING, STRING, text_type):
                    tasks.start_soon(hear, type_)
                await until(lambda: odom.reader_count() == 2)
                await anyio.wait_all_tasks_blocked()
                await odom.publish({"data": text})
        assert heard == ["a"] * 3 + ["b"] * 3  # each call has the message that comes after it
        assert kept.reader_count() == 1


async def test_a_subscription_that_no_call_used_for_a_while_is_closed(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "KEPT_OPEN", 0.05)
    async with two_nodes(scheme) as (robot, planner):
        chart = robot.publisher("chart", STRING)
        kept = robot.publisher("map", STRING, qos="transient_local")
        await kept.publish({"data": "kept"})
        assert planner.latest("chart", STRING) is None
        await planner.next("map", STRING, qos="transient_local", timeout=PATIENCE)
        await until(lambda: planner._newest._shared.keys() == {(chart.topic, STRING, EndQos())})
        await until(lambda: not kept.reader_count() and chart.reader_count() == 1)
        with pytest.raises(TimeoutError, match=r"nothing arrived on .*/odom in 0.01 s"):
            await planner.next("odom", STRING, timeout=0.01)


async def test_the_shared_subscription_that_was_used_first_gives_way(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(topics, "MOST_SHARED", 2)
    async with two_nodes(scheme) as (_, planner), anyio.create_task_group() as tasks:
        tasks.start_soon(planner.next, "awaited", STRING)
        await anyio.wait_all_tasks_blocked()
        for name in ("a", "b", "c"):
            planner.latest(name, STRING)
            shared = [topic.rpartition("/")[2] for topic, *_ in planner._newest._shared]
            assert shared == ["awaited", name]
        tasks.cancel_scope.cancel()


async def test_a_call_for_one_message_keeps_no_publisher_waiting(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        publisher = robot.publisher("odom", STRING, qos="keep_all", depth=2)
        assert planner.latest("odom", STRING, qos="keep_all") is None
        await publisher.wait_for_reader(PATIENCE)
        for number in range(20):
            await publisher.publish({"data": str(number)}, timeout=SILENCE / 2)

        def newest_is_there() -> bool:
            found = planner.latest("odom", STRING, qos="keep_all")
            return found is not None and found.data == "19"

        await until(newest_is_there)


async def test_a_late_reader_gets_what_is_latched(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        latched = robot.publisher("map", STRING, qos="transient_local", depth=1)
        with planner.subscribe("map", STRING) as early:
            await latched.wait_for_reader(PATIENCE)
            with pytest.raises(TimeoutError, match="is read with qos='transient_local'"):
                await early.next(0.01)
            for text in ("old", "new"):
                await latched.publish({"data": text})
                assert (await early.next()).data == text
        found = await planner.next("map", STRING, qos="transient_local", timeout=PATIENCE)
        assert found.data == "new"


async def test_what_keeps_messages_away_is_told(
    scheme: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(topics, "SILENCE", 0.01)
    async with two_nodes(scheme) as (robot, planner):
        with pytest.raises(TimeoutError, match=r"/nothing in 0.05 s: no node publishes it"):
            await planner.next("nothing", STRING, timeout=0.05)
        weak = robot.publisher("map", STRING)
        wanted = planner.subscribe("map", STRING, qos="transient_local")
        await until(lambda: planner._ros.publishers(weak.topic))
        text = (
            "robot offers volatile, and this subscription wants transient_local:"
            " subscribe with qos='volatile'"
        )
        if scheme == "dds://":  # over Zenoh they hear each other
            with pytest.raises(TimeoutError, match=text):
                await wanted.next(0.5)  # the log tells it before
            assert text in caplog.text
        else:
            with pytest.raises(TimeoutError, match="connected publishers: 1"):
                await wanted.next(0.5)
        other = planner.subscribe("map", "std_msgs/msg/Int32")
        with pytest.raises(TimeoutError, match="its publishers have the type std_msgs/msg/String"):
            await other.next(0.05)
        numbers = robot.publisher("map", "std_msgs/msg/Int64")
        await until(lambda: len(robot._ros.subscriptions(weak.topic)) == 2)
        text = "its subscriptions have the type std_msgs/msg/Int32 and std_msgs/msg/String"
        with pytest.raises(TimeoutError, match=text):
            await numbers.wait_for_reader(0.05)
        numbers.close()
        if scheme == "dds://":  # over Zenoh they hear each other
            only = robot.publisher("weak", STRING, qos="best_effort")
            planner.subscribe("weak", STRING)
            await until(lambda: robot._ros.subscriptions(only.topic))
            with pytest.raises(TimeoutError, match=r"offers best_effort, and .* wants reliable"):
                await only.wait_for_reader(0.05)
        with pytest.raises(TimeoutError, match=r"nobody has subscribed to .*/alone in 0.05 s"):
            await robot.publisher("alone", STRING).wait_for_reader(0.05)
        silent = planner.subscribe("map", STRING)
        await weak.wait_for_reader(PATIENCE)
        with pytest.raises(TimeoutError, match="connected publishers: 1"):
            await silent.next(0.05)
        later = TypeVersion(STRING, "RIHS01_00")
        monkeypatch.setattr(planner._ros.types, "version", lambda message: later)
        with pytest.raises(TimeoutError, match="another version of std_msgs/msg/String"):
            await silent.next(0.05)


async def test_a_service_is_called_once_and_answers_by_functions_of_both_kinds(
    scheme: str,
) -> None:
    requests: list[bool] = []

    async def reset(request: Any) -> dict[str, Any]:
        requests.append(request.data)
        return {"success": True, "message": "done"}

    async with two_nodes(scheme) as (robot, planner):
        with robot.serve_service("reset", BOOL, reset):
            answer = await planner.call("reset", BOOL, {"data": True}, timeout=PATIENCE)
            assert (answer.success, answer.message, requests) == (True, "done", [True])
            again = await planner.call("reset", BOOL, timeout=PATIENCE)
            assert (again.success, requests) == (True, [True, False])
        with robot.serve_service("tell", BOOL, lambda request: None):
            assert not (await planner.call("tell", BOOL, timeout=PATIENCE)).success


async def test_a_call_that_has_no_answer_says_why(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    async def never(request: Any) -> None:
        await anyio.sleep_forever()

    def wrong(request: Any) -> dict[str, Any]:
        return {"successful": True}

    async with two_nodes(scheme) as (robot, planner):
        with pytest.raises(TimeoutError, match=r"/nowhere: there is no server in 0.05 s"):
            await planner.call("nowhere", BOOL, timeout=0.05)
        with pytest.raises(ValueError, match=r"/nowhere: not a std_srvs/SetBool_Request: .*`on`"):
            await planner.call("nowhere", BOOL, {"on": True})
        with robot.serve_service("slow", BOOL, never):
            with pytest.raises(TimeoutError, match="the server has not answered in 2 s"):
                await planner.call("slow", BOOL, timeout=2)
            with pytest.raises(TimeoutError, match="nothing was asked in 0 s"):
                await planner.call("slow", BOOL, timeout=0)
            text = "there is no server in 0.1 s: it is a service of std_srvs/srv/SetBool"
            with pytest.raises(TimeoutError, match=text):
                await planner.call("slow", "std_srvs/srv/Trigger", timeout=0.1)
        with robot.serve_service("wrong", BOOL, wrong):
            assert not (await planner.call("wrong", BOOL, timeout=PATIENCE)).success
        assert "a request failed: not a std_srvs/SetBool_Response" in caplog.text


async def test_a_call_ends_when_the_server_that_it_asked_is_gone_or_takes_no_more(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "GONE_PAUSE", 0.01)
    asked = told = 0

    async def never(request: Any) -> None:
        nonlocal asked
        asked += 1
        await anyio.sleep_forever()

    async def is_told(planner: Node) -> None:
        with pytest.raises(ConnectionLost, match="has gone, or has thrown"):
            await planner.call("slow", BOOL)
        nonlocal told
        told += 1

    async with two_nodes(scheme) as (robot, planner), anyio.create_task_group() as tasks:
        with robot.serve_service("slow", BOOL, never):
            for _ in range(services.AT_ONCE):
                tasks.start_soon(is_told, planner)
            await until(lambda: asked == services.AT_ONCE)
            with pytest.raises(TimeoutError, match="its last 8 requests have no answers"):
                await planner.call("slow", BOOL, timeout=0.1)
        with robot.serve_service("slow", BOOL, never):  # it is another one
            await until(lambda: told == services.AT_ONCE)


async def test_an_answer_that_comes_too_late_is_ignored(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(DdsCaller, "forget", lambda self, number: None)  # as with rclpy
    late = anyio.Event()

    async def slow(request: Any) -> dict[str, Any]:
        if request.data:
            await late.wait()
        return {"success": not request.data}

    async with two_nodes("dds://") as (robot, planner):
        with robot.serve_service("slow", BOOL, slow):
            assert (await planner.call("slow", BOOL)).success
            with pytest.raises(TimeoutError, match="has not answered"):
                await planner.call("slow", BOOL, {"data": True}, timeout=0.1)
            late.set()
            assert (await planner.call("slow", BOOL)).success
    assert not caplog.records


async def test_a_server_that_may_not_know_its_client_yet_has_a_moment_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(DdsNode, "confirms_callers", False)  # as with rclpy
    monkeypatch.setattr(services, "ACQUAINTED", 0.01)
    async with two_nodes("dds://") as (robot, planner):
        with robot.serve_service("reset", BOOL, lambda request: {"success": True}):
            assert (await planner.call("reset", BOOL)).success


async def test_over_zenoh_a_call_ends_with_its_server() -> None:
    asked = anyio.Event()

    async def never(request: Any) -> None:
        asked.set()
        await anyio.sleep_forever()

    async with (
        open_node("zenoh:///planner", arguments=[]) as planner,
        anyio.create_task_group() as tasks,
    ):
        async with open_node("zenoh:///robot", arguments=[]) as robot:
            name = f"/s{uuid.uuid4().hex}"
            with robot.serve_service(name, BOOL, never):

                async def is_told() -> None:
                    with pytest.raises(ConnectionLost, match="has gone, or has thrown"):
                        await planner.call(name, BOOL)

                tasks.start_soon(is_told)
                await asked.wait()


async def test_a_call_for_one_message_may_end_after_its_node_was_closed(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = anyio.Event()

    async def upcoming(*_: object) -> None:
        await closed.wait()
        raise ConnectionLost("the node was closed here")

    monkeypatch.setattr(topics.Subscription, "upcoming", upcoming)
    async with anyio.create_task_group() as tasks:
        async with two_nodes(scheme) as (_, planner):

            async def is_told() -> None:
                with pytest.raises(ConnectionLost, match="the node was closed here"):
                    await planner.next("chatter", STRING)

            tasks.start_soon(is_told)
            await anyio.wait_all_tasks_blocked()
        closed.set()


async def test_nothing_is_begun_or_waited_for_at_a_node_that_was_closed(scheme: str) -> None:
    async with two_nodes(scheme) as (_, planner):
        alone = planner.publisher("alone", STRING)
        heard = planner.subscribe("alone", STRING)
    heard.close()

    def serves() -> None:
        with planner.serve_service("reset", BOOL, lambda request: None):
            pytest.fail("a closed node serves")

    with pytest.raises(ConnectionLost, match="the node was closed here"):
        serves()
    with pytest.raises(ConnectionLost, match="the node was closed here"):
        planner.subscribe("alone", STRING)
    for waits in (
        lambda: planner.transform("base", "map"),
        lambda: planner.type_of("nothing"),
        lambda: planner.call("nothing", BOOL),
        alone.wait_for_reader,
    ):
        with pytest.raises(ConnectionLost, match="the node was closed here"):
            await waits()


def not_odd(value: int) -> None:
    if value % 2:
        raise ValueError(f"{value} is odd")


async def test_declared_parameters_are_served_checked_and_watched_at_both_ends(
    scheme: str,
) -> None:
    async with two_nodes(scheme) as (robot, planner):
        own = robot.parameters()
        assert own.declare("speed", 0.5, description="Metres a second.", low=0.0, high=2.0) == 0.5
        own.declare("arm.wheels", 4, low=2, check=not_odd)
        own.declare("names", ["a"])
        own.declare("frame", "base", is_read_only=True)
        names = ["use_sim_time", "speed", "arm.wheels", "names", "frame"]
        assert await own.list() == names
        others = planner.parameters(robot.name, timeout=PATIENCE)
        assert await others.list() == names
        values = {"speed": 0.5, "arm.wheels": 4, "names": ["a"], "frame": "base"}
        assert await others.get() == await own.get() == {"use_sim_time": False, **values}
        changes, told = own.watch(), others.watch()
        async with anyio.create_task_group() as tasks:

            async def set_again() -> None:
                while True:
                    await others.set({"speed": 1.5, "names": []})
                    await anyio.sleep(0.01)

            tasks.start_soon(set_again)
            assert await anext(changes) == await anext(told) == {"speed": 1.5, "names": []}
            tasks.cancel_scope.cancel()
        await changes.aclose()
        await told.aclose()
        assert (own["speed"], own["names"]) == (1.5, [])
        refused: dict[str, Any]
        for refused, reason in (
            ({"speed": 3.0}, "'speed' is at least 0 and at most 2, and not 3.0"),
            ({"speed": 1}, "'speed' is a double"),
            ({"speed": 0.1, "arm.wheels": 3}, "3 is odd"),
            ({"names": [1]}, "'names' is a string_array"),
            ({"frame": "map"}, "'frame' is read-only"),
            ({"height": 1.0}, "there is no parameter 'height', only 'use_sim_time', 'speed'"),
        ):
            for end in (own, others):
                with pytest.raises(ValueError, match=reason):
                    await end.set(refused)
        assert own["speed"] == 1.5
        unfit: Any = {"speed": [1, "a"]}
        with pytest.raises(TypeError, match="cannot be a parameter"):
            await others.set(unfit)
        assert await others.get("height", "frame") == {"height": None, "frame": "base"}
        for call, error, reason in (
            (lambda: own.declare("speed", 1.0), ValueError, "'speed' is declared already"),
            (lambda: own.declare("odd", 1, check=not_odd), ValueError, "1 is odd"),
            (lambda: own.declare("unset", None), TypeError, "'unset' needs a default"),
            (lambda: own.declare("", 1), ValueError, "a parameter needs a name"),
            (lambda: own.declare("arm", "a", low=1), TypeError, "low and high are for numbers"),
            (lambda: own["nothing"], KeyError, "nothing"),
        ):
            with pytest.raises(error, match=reason):
                call()

        async def ask(words: str, request: dict[str, Any]) -> Any:
            service = "".join(f"_{one.lower()}" if one.isupper() else one for one in words)[1:]
            return await planner.call(
                f"{robot.name}/{service}", f"rcl_interfaces/srv/{words}", request
            )

        asked = {"names": ["speed", "arm.wheels", "nothing"]}
        assert bytes((await ask("GetParameterTypes", asked)).types) == b"\3\2\0"
        each = [("speed", 3.0), ("speed", 0.5)]
        wanted = [{"name": name, "value": written(value)} for name, value in each]
        results = (await ask("SetParameters", {"parameters": wanted})).results
        assert [one.successful for one in results] == [False, True]
        speed, wheels, nothing = (await ask("DescribeParameters", asked)).descriptors
        assert (speed.type, speed.description, speed.read_only) == (3, "Metres a second.", False)
        assert speed.floating_point_range[0].to_value == 2.0
        assert (wheels.type, wheels.integer_range[0].to_value) == (2, 2**63 - 1)
        assert (nothing.type, nothing.integer_range) == (0, [])
        lists: Any
        for lists, found in (
            ({"prefixes": ["arm"]}, (["arm.wheels"], ["arm"])),
            ({"depth": 1}, (["use_sim_time", "speed", "names", "frame"], [])),
        ):
            result = (await ask("ListParameters", lists)).result
            assert (list(result.names), list(result.prefixes)) == found


def trusting(value: object) -> None:
    raise RuntimeError("cut")


async def test_the_values_of_arguments_and_files_are_those_of_declared_parameters(
    scheme: str, tmp_path: Path
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("/**: {ros__parameters: {gains: {p: 2.5}, joints: [a, b], loud: 'on'}}")
    words = [
        "-p",
        "wheels:=0x10",
        "-p",
        "ids:=[1, 2]",
        "-p",
        "name:='7'",
        "-p",
        "speed:=fast",
        "-p",
        "id:=a",
    ]
    arguments = ["--ros-args", "--params-file", str(file), *words]
    async with open_node(f"{scheme}robot", arguments=arguments) as robot:
        own = robot.parameters()
        assert own.declare("gains.p", 1.0) == 2.5
        assert own.declare("joints", ["x"]) == ["a", "b"]
        assert own.declare("loud", False) is True
        assert own.declare("wheels", 4) == 16
        assert own.declare("ids", [0]) == [1, 2]
        assert own.declare("name", "") == "7"
        wrong: Any
        for name, wrong, problem in (
            ("speed", 0.5, "-p speed:=fast: expected a double"),
            ("id", "a", "-p id:=a: RuntimeError: cut"),
            ("joint", 1, "'joint' is at least 2, and not 1"),
            ("ids2", 2, "RuntimeError: cut"),
        ):
            with pytest.raises(ValueError, match=problem):
                own.declare(name, wrong, low=2 if wrong == 1 else None, check=trusting)
        for name, wrong in (("joints2", [1]), ("loud2", b""), ("gains", True)):
            assert own.declare(name, wrong) == wrong
        values = "-p", "many:=[1, [2]]", "-p", "raw:=x", "-p", "flag:=7"
        async with open_node(f"{scheme}other", arguments=["--ros-args", *values]) as other:
            for name, wrong, word in (
                ("many", [1], "an integer_array"),
                ("raw", b"", "a byte_array"),
                ("flag", True, "true or false"),
            ):
                with pytest.raises(ValueError, match=f"-p {name}:=.*: expected {word}"):
                    other.parameters().declare(name, wrong)


async def test_changes_of_parameters_are_watched(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        events = robot.publisher("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
        changes = planner.parameters(robot.name).watch()
        values: dict[str, Any] = {"a": True, "e": b"y", "g": [0.5]}

        async def tell() -> None:
            await events.wait_for_reader(PATIENCE)
            await events.publish({"node": "/another"})
            changed = [{"name": name, "value": written(value)} for name, value in values.items()]
            deleted = [{"name": "z"}]
            await events.publish(
                {
                    "node": robot.name,
                    "changed_parameters": changed,
                    "deleted_parameters": deleted,
                }
            )

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(tell)
            assert await anext(changes) == {**values, "z": None}
        await changes.aclose()


PART = "fibaction_test_msgs/msg/Part"


async def test_a_type_without_a_file_is_learned_from_its_publisher(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with two_nodes(scheme) as (robot, planner):
        with pytest.raises(TimeoutError, match=r"no node has had the topic .*/part in 0.05 s"):
            await planner.type_of("part", timeout=0.05)
        publisher = robot.publisher("part", "fibaction_test_msgs/msg/Part")
        monkeypatch.setenv("FIBACTION_SEARCH", "")
        async with open_node(f"{scheme}stranger", arguments=[]) as stranger:
            assert await stranger.type_of(publisher.topic, timeout=PATIENCE) == PART
            assert await stranger.type_of(publisher.topic) == PART
            heard = stranger.subscribe(publisher.topic, PART)
            await publisher.wait_for_reader(PATIENCE)
            await publisher.publish({})
            assert type(await heard.next()).__name__ == "Part"


async def test_generated_messages_and_services_need_no_files(scheme: str, tmp_path: Path) -> None:
    for name, text in (
        ("msg/Probe.msg", "string PART=arm\nfloat64 depth\nPart part\n"),
        ("msg/Part.msg", "string name\n"),
        ("srv/AskDepth.srv", "Part part\n---\nProbe[] probes\n"),
    ):
        (tmp_path / "probe_msgs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "probe_msgs" / name).write_text(text)
    types = [
        read_interface(tmp_path / "probe_msgs" / one, [])
        for one in ("msg/Probe.msg", "srv/AskDepth.srv")
    ]
    made: dict[str, Any] = {"__name__": "probe_types"}
    exec(compile(types_source(types), "probe", "exec", dont_inherit=True), made)
    probe, part, service = made["Probe"], made["Part"], made["ASK_DEPTH"]

    def ask(request: Any) -> Any:
        assert type(request) is made["AskDepth_Request"]
        return made["AskDepth_Response"](probes=[probe(depth=2.0, part=request.part)])

    async with two_nodes(scheme) as (robot, planner):
        heard = planner.subscribe("probe", probe)
        publisher = robot.publisher("probe", probe)
        await publisher.wait_for_reader(PATIENCE)
        await publisher.publish(probe(depth=1.5, part=part(name=probe.PART)))
        assert await heard.next(PATIENCE) == probe(depth=1.5, part=part(name="arm"))
        with robot.serve_service("ask", service, ask):
            request = made["AskDepth_Request"](part=part(name="leg"))
            answer = await planner.call("ask", service, request, timeout=PATIENCE)
            assert answer.probes == [probe(depth=2.0, part=part(name="leg"))]
            plain = await planner.call("ask", "probe_msgs/srv/AskDepth", timeout=PATIENCE)
            assert plain.probes[0].depth == 2.0
            narrow = Service(service.type_name, service.request, Narrow)
            with pytest.raises(ProtocolError, match="probes"):
                await planner.call("ask", narrow, request)


async def test_the_node_serves_and_calls_actions_and_leaves_them_with_their_blocks(
    scheme: str,
) -> None:
    async with two_nodes(scheme) as (robot, planner):
        tasks = len(anyio.get_running_tasks())
        async with serve(ActionServer(FIBONACCI, fibonacci), robot) as url:
            assert url[0].startswith(scheme.rstrip("/"))
            async with connect(planner, FIBONACCI) as client:
                assert await client.call(Goal(5)) == Result([0, 1, 1, 2, 3, 5])
        feedback = robot.full_name("fibonacci/_action/feedback")
        await until(lambda: feedback not in planner.topics())
        await until(lambda: len(anyio.get_running_tasks()) <= tasks)
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), robot),
            connect(planner, FIBONACCI) as client,
        ):
            assert await client.call(Goal(5)) == Result([0, 1, 1, 2, 3, 5])


async def test_the_ends_of_one_node_hear_each_other(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, _):
        latched = robot.publisher("map", STRING, qos="transient_local")
        await latched.publish({"data": "before"})
        heard = robot.subscribe("map", STRING, qos="transient_local")
        await until(lambda: latched.reader_count() == heard.publisher_count() == 1)
        await latched.publish({"data": "after"})
        assert [(await heard.next(PATIENCE)).data for _ in range(2)] == ["before", "after"]
        weak = robot.publisher("map", STRING, qos="best_effort")
        assert heard.publisher_count() == (1 if scheme == "dds://" else 2)
        heard.close()
        await until(lambda: not latched.reader_count())
        with robot.subscribe("map", STRING, qos="best_effort") as late:
            await until(lambda: late.publisher_count() == 2)
            weak.close()
            await until(lambda: late.publisher_count() == 1)
        with robot.serve_service("reset", BOOL, lambda request: {"success": request.data}):
            assert (await robot.call("reset", BOOL, {"data": True}, timeout=PATIENCE)).success
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), robot),
            connect(robot, FIBONACCI) as client,
        ):
            assert await client.call(Goal(5)) == Result([0, 1, 1, 2, 3, 5])


async def test_other_addresses_are_no_nodes() -> None:
    with pytest.raises(InvalidURL, match="a node of ROS is at ros2://, dds:// or zenoh://"):
        async with open_node("tcp://127.0.0.1:1"):
            pass


def told(parent: str, child: str, x: float, second: int) -> dict[str, Any]:
    header = {"frame_id": parent, "stamp": {"sec": second}}
    transform = {"translation": {"x": x}, "rotation": {"w": 1.0}}
    one = {"header": header, "child_frame_id": child, "transform": transform}
    return {"transforms": [one]}


async def test_a_transform_is_waited_for_and_interpolated(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        static = robot.publisher("/tf_static", TF, qos="transient_local")
        moving = robot.publisher("/tf", TF, depth=100)
        with pytest.raises(TimeoutError, match=r"of base to map in 0.05 s: nothing is known of"):
            await planner.transform("base", "map", timeout=0.05)
        await static.publish(told("map", "odom", 1.0, 0))
        await moving.wait_for_reader(PATIENCE)
        await moving.publish(told("odom", "base", 1.0, 10))
        await moving.publish(told("odom", "base", 3.0, 12))
        assert (await planner.transform("base", "map", at=12)).x == 4.0
        assert (await planner.transform("base", "map", at=11)).x == 3.0
        assert (await planner.transform("map", "base")).x == -4.0


@asynccontextmanager
async def bare_node(name: str) -> AsyncGenerator[tuple[Node, DdsNode], None]:
    """Open a node over DDS, and give also what is below it."""
    settings = NodeSettings(name, "/bare", None, [])
    async with DdsAdapter(settings, DdsSettings()).open() as ros, Background() as tasks:
        yield Node(ros, DdsSettings(), tasks, "dds"), ros


async def test_a_simulation_that_begins_anew_has_new_transforms() -> None:
    with anyio.fail_after(PATIENCE):
        async with bare_node("robot") as (robot, _), bare_node("planner") as (planner, below):
            static = robot.publisher("/tf_static", TF, qos="transient_local")
            moving = robot.publisher("/tf", TF)
            await static.publish(told("map", "odom", 1.0, 0))
            with pytest.raises(TimeoutError):
                await planner.transform("base", "map", timeout=0.01)
            await moving.wait_for_reader()
            await moving.publish(told("odom", "base", 1.0, 100))
            assert (await planner.transform("base", "map")).x == 2.0
            below.clock.era += 1  # the time has jumped back
            await moving.publish(told("odom", "base", 2.0, 1))
            assert (await planner.transform("base", "map", at=1)).x == 3.0


async def test_a_transform_is_waited_for_by_the_clock_of_a_simulation(scheme: str) -> None:
    async with two_nodes(scheme) as (robot, planner):
        clock = robot.publisher("/clock", "rosgraph_msgs/msg/Clock")
        moving = robot.publisher("/tf", TF)

        async def tell_time(seconds: int) -> None:
            await clock.publish({"clock": {"sec": seconds}})
            await until(lambda: planner._ros.clock.now() == seconds * 10**9)

        await planner.parameters().set({"use_sim_time": True})
        with pytest.raises(TimeoutError):  # no time has come yet: that of the machine counts
            await planner.transform("base", "map", timeout=0.05)
        await until(lambda: clock.reader_count() and moving.reader_count())
        await tell_time(100)
        async with anyio.create_task_group() as tasks:

            async def wait() -> None:
                assert (await planner.transform("base", "map", timeout=0.05)).x == 2.0

            tasks.start_soon(wait)
            await anyio.sleep(0.2)  # the simulation stands still
            await moving.publish(told("map", "base", 2.0, 100))
        async with anyio.create_task_group() as tasks:

            async def give_up() -> None:
                with pytest.raises(TimeoutError, match="no transform of arm to map in 500 s"):
                    await planner.transform("arm", "map", timeout=500)

            tasks.start_soon(give_up)
            await anyio.wait_all_tasks_blocked()
            await tell_time(700)


class Simulated(RosClock):
    """A clock that a test sets."""

    is_the_machines = False

    def __init__(self) -> None:
        self.era = self.time = 0

    def now(self) -> int:
        return self.time * 10**9


async def test_a_timeout_begins_anew_with_its_simulation() -> None:
    clock = Simulated()
    patience = transforms.Patience(clock, 10)
    assert patience.left() > transforms.CLOCK_PAUSE
    clock.time = 500
    assert patience.left() == transforms.CLOCK_PAUSE  # the first time is no jump
    clock.time = 505
    assert patience.left() > 0
    clock.time, clock.era = 3, 1
    assert patience.left() > 0
    clock.time = 12
    assert patience.left() > 0
    clock.time = 13
    assert patience.left() == 0


async def test_the_loss_of_a_node_ends_what_waits_for_it() -> None:
    begun = anyio.Event()

    async def never(request: Any) -> None:
        begun.set()
        await anyio.sleep_forever()

    lost: list[str] = []

    async def is_lost(waits: Callable[[], Any]) -> None:
        with pytest.raises(ConnectionLost, match="cut"):
            await waits()
        lost.append("once")

    with anyio.fail_after(PATIENCE):
        async with bare_node("robot") as (robot, _), bare_node("planner") as (planner, below):
            heard = planner.subscribe("chatter", STRING)
            publisher = planner.publisher("chatter", STRING)
            with robot.serve_service("slow", BOOL, never):
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(is_lost, heard.next)
                    tasks.start_soon(is_lost, planner.parameters().watch().__anext__)
                    tasks.start_soon(is_lost, lambda: planner.call("slow", BOOL))
                    tasks.start_soon(is_lost, lambda: planner.call("nowhere", BOOL))
                    await until(begun.is_set)
                    below.fail(ConnectionLost("cut"))
                await is_lost(lambda: publisher.publish({}))
                with pytest.raises(ConnectionLost):
                    planner.parameters().declare("speed", 1.0)
    assert len(lost) == 5


async def test_an_answer_or_a_message_that_cannot_be_read_is_told_and_nothing_else_is_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    wrong = b"\0\1\0\0\xff\xff\xff\xff"
    with anyio.fail_after(PATIENCE):
        async with bare_node("robot") as (robot, below), bare_node("planner") as (planner, _):
            heard = planner.subscribe("chatter", STRING)
            types = below.types
            raw = below.publisher("/bare/chatter", types.topic_type(STRING).message, EndQos())
            await until(raw.reader_count)
            ours = robot.publisher("chatter", STRING)
            await ours.wait_for_reader()
            await ours.publish(types.topic_type(STRING).message(data="ours"))
            assert (await heard.next()).data == "ours"
            raw.publish_bytes(wrong)
            await until(lambda: heard.latest is None)
            raw.publish(types.topic_type(STRING).message(data="right"))
            assert (await heard.next()).data == "right"
            assert (
                "a message on /bare/chatter was dropped (1 so far): it cannot be read"
                in caplog.text
            )
            frames = below.publisher("/tf", types.topic_type(TF).message, EndQos())
            with pytest.raises(TimeoutError):
                await planner.transform("base", "map", timeout=0.01)
            await until(frames.reader_count)
            frames.publish_bytes(wrong)
            await until(lambda: "a message of /tf cannot be read" in caplog.text)
            called = types.called_type(BOOL).service
            called.Response.codec.encode = lambda response: wrong
            with (
                robot.serve_service("reset", BOOL, lambda request: None),
                pytest.raises(ConnectionLost, match="/bare/reset: "),
            ):
                await planner.call("reset", BOOL)


async def test_messages_of_any_bytes_are_dropped_and_counted_and_the_next_one_is_read(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    sent, chance = 200, random.Random(1)
    text = structs_of([read_message(STRING, SearchPath((), ()))])["String"]
    async with two_nodes(scheme) as (robot, planner):
        for type_, field in ((ODOMETRY, "child_frame_id"), (text, "data")):
            heard = planner.subscribe(field, type_, depth=sent + 1)
            publisher = robot.publisher(field, type_, depth=sent + 1)
            await publisher.wait_for_reader()
            for _ in range(sent):
                head = chance.choice([b"\0\1\0\0", b"\0\0\0\0", chance.randbytes(4)])
                publisher._part.publish_bytes(head + chance.randbytes(4 * chance.randrange(99)))
            await publisher.publish({field: "right"})
            read = 0
            while getattr(await heard.next(), field) != "right":
                read += 1
            assert read + heard.dropped == sent
            assert heard.dropped > sent / 2
    lines = [one for one in caplog.messages if "it cannot be read" in one]
    assert 2 <= len(lines) <= 2 * sent.bit_length()


async def test_a_type_that_nobody_describes_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(file_types, "MOST_LEARNED", 1)
    with anyio.fail_after(PATIENCE):
        async with bare_node("robot") as (robot, below):
            kept = [robot.publisher(name, PART) for name in ("part", "other")]
            monkeypatch.setenv("FIBACTION_SEARCH", "")
            async with bare_node("stranger") as (stranger, _):
                assert await stranger.type_of(kept[0].topic) == PART
            monkeypatch.setattr(below.in_use, "_by_hash", {})
            async with bare_node("stranger") as (stranger, _):
                await until(lambda: kept[0].topic in stranger.topics())
                with pytest.raises(TransportError, match=f"{PART} cannot be used"):
                    await stranger.type_of(kept[0].topic)
                assert f"/bare/robot describes {PART}: " in caplog.text


@pytest.mark.parametrize(
    ("value", "fields"),
    [
        (None, {"type": 0}),
        (True, {"type": 1, "bool_value": True}),
        (b"ab", {"type": 5, "byte_array_value": b"ab"}),
        ([], {"type": 9, "string_array_value": []}),
        ([0.5], {"type": 8, "double_array_value": [0.5]}),
    ],
)
def test_a_value_is_written_as_the_parameter_that_has_its_type(value: Any, fields: Any) -> None:
    assert written(value) == fields


@pytest.mark.parametrize("value", [{}, [1, True], object()])
def test_a_value_that_no_parameter_has_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be a parameter"):
        written(value)
