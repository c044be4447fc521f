"""Topics, services and parameters of our node beside a stock node of rclpy."""

from __future__ import annotations

from queue import Queue
from typing import Any

import anyio
import msgspec
import pytest
from rcl_interfaces.srv import ListParameters
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import LivelinessPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import String

from fibaction import ConnectionLost, TransportError
from fibaction_transports.ros2 import EndQos, open_node
from tests.ros2.spun import beside_rclpy
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = pytest.mark.anyio

STRING, LIST = "std_msgs/msg/String", "rcl_interfaces/srv/ListParameters"


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def test_messages_go_both_ways_and_a_removed_end_is_gone(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        topic = node.full_name("chatter")
        heard: Queue[str] = Queue()
        reader = stock.create_subscription(String, topic, lambda one: heard.put(one.data), 10)
        with node.publisher("chatter", STRING) as publisher:
            await publisher.wait_for_reader(PATIENCE)
            await until(reader.get_publisher_count)  # before, it loses what is sent
            await publisher.publish({"data": "ours"})
            await until(heard.qsize)
            assert heard.get() == "ours"
        await until(lambda: not reader.get_publisher_count())
        stock.destroy_subscription(reader)
        writer = stock.create_publisher(String, topic, 10)
        with node.subscribe("chatter", String) as messages:
            await until(writer.get_subscription_count)
            await until(messages.publisher_count)
            writer.publish(String(data="theirs"))
            assert await messages.next() == String(data="theirs")
        await until(lambda: writer.get_subscription_count() == 0)
        assert node.topics()[topic] == STRING
        assert await node.type_of("chatter") == STRING


async def test_a_publisher_that_keeps_all_waits_for_its_reader(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, _):
        slow = node.subscribe("chatter", STRING, qos="keep_all", depth=4)
        publisher = node.publisher("chatter", STRING, qos="keep_all", depth=4)
        await until(lambda: publisher.reader_count() and slow.publisher_count())
        async with anyio.create_task_group() as tasks:

            async def publish() -> None:
                for number in range(300):
                    await publisher.publish({"data": str(number)}, timeout=PATIENCE)

            tasks.start_soon(publish)
            await anyio.wait_all_tasks_blocked()
            found = [(await slow.next(PATIENCE)).data for _ in range(300)]
        assert found == [str(number) for number in range(300)]
        assert slow.dropped == 0


async def test_a_topic_of_rclpy_is_followed_with_its_quality_of_service(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        writer = stock.create_publisher(String, node.full_name("scan"), qos_profile_sensor_data)
        with await node.follow("scan", timeout=PATIENCE) as scan:
            await until(writer.get_subscription_count)
            await until(scan.publisher_count)
            writer.publish(String(data="theirs"))
            assert (await scan.next(PATIENCE)).data == "theirs"


async def test_services_are_called_and_served(scheme: str) -> None:
    def answer(request: Any, response: Any) -> Any:
        response.result.names = list(request.prefixes)
        return response

    async with beside_rclpy(scheme) as (node, stock):
        stock.create_service(ListParameters, node.full_name("theirs"), answer)
        found = await node.call("theirs", LIST, {"prefixes": ["a"]}, timeout=PATIENCE)
        assert list(found.result.names) == ["a"]
        client = stock.create_client(ListParameters, node.full_name("ours"))
        with node.serve_service(
            "ours", LIST, lambda request: {"result": {"names": list(request.prefixes)}}
        ):
            await until(client.service_is_ready)
            asked = client.call_async(ListParameters.Request(prefixes=["b"]))
            await until(asked.done)
            assert list(asked.result().result.names) == ["b"]
        await until(lambda: not client.service_is_ready())


async def test_parameters_are_read_set_and_watched(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        stock.declare_parameter("speed", 0.5)
        stock.declare_parameter("names", ["a"])
        parameters = node.parameters(stock.get_fully_qualified_name(), timeout=PATIENCE)
        assert {"speed", "names"} <= {*await parameters.list()}
        assert await parameters.get("speed", "names") == {"speed": 0.5, "names": ["a"]}
        changes = parameters.watch()
        async with anyio.create_task_group() as tasks:

            async def set_again() -> None:
                number = 0.0
                while True:
                    number += 1.0
                    await parameters.set({"speed": number})
                    await anyio.sleep(0.05)

            tasks.start_soon(set_again)
            changed = await anext(changes)
            tasks.cancel_scope.cancel()
        await changes.aclose()
        assert [*changed] == ["speed"]
        with pytest.raises(ValueError, match="refuses"):
            await parameters.set({"speed": "fast"})


def not_odd(value: int) -> None:
    if value % 2:
        raise ValueError(f"{value} is odd")


async def test_declared_parameters_are_seen_set_and_refused_by_rclpy(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        own = node.parameters()
        assert own.declare("speed", 0.5, high=2.0) == 0.5
        assert own.declare("wheels", 4, low=2, check=not_odd) == 4
        assert own.declare("raw", b"ab") == b"ab"
        with pytest.raises(ValueError, match="declared"):
            own.declare("wheels", 6)
        with pytest.raises(ValueError, match="1 is odd"):
            own.declare("odd", 1, check=not_odd)
        assert {"speed", "wheels"} <= {*await own.list()}
        assert (await own.get("speed", "nothing")) == {"speed": 0.5, "nothing": None}
        asked = AsyncParameterClient(stock, node.name)
        await until(asked.services_are_ready)
        changes = own.watch()
        async with anyio.create_task_group() as tasks:

            async def set_again() -> None:
                while True:
                    future = asked.set_parameters([Parameter("wheels", value=6)])
                    await until(future.done)
                    assert future.result().results[0].successful

            tasks.start_soon(set_again)
            assert await anext(changes) == {"wheels": 6}
            tasks.cancel_scope.cancel()
        await changes.aclose()
        for name, value in (("wheels", 3), ("wheels", 0), ("speed", 2.5), ("speed", "fast")):
            future = asked.set_parameters([Parameter(name, value=value)])
            await until(future.done)
            (result,) = future.result().results
            assert not result.successful
            assert value != 3 or result.reason == "3 is odd"
            with pytest.raises(ValueError, match=r"\w"):
                await own.set({name: value})
        await own.set({"speed": 1.5})
        assert own["speed"] == 1.5


async def test_a_quality_of_service_that_does_not_match_is_told(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        heard: list[Any] = []
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)  # they warn of themselves
        stock.create_subscription(
            String, node.full_name("map"), heard.append, 10, event_callbacks=quiet
        )
        weak = node.publisher("map", STRING, qos="best_effort")
        await until(lambda: any(end.node for end in node._ros.subscriptions(weak.topic)))
        text = "this publisher offers best_effort, and .*stock wants reliable"
        with pytest.raises(TimeoutError, match=text):
            await weak.wait_for_reader(0.1)
        with pytest.raises(TimeoutError, match=r"fewer than 2 have subscribed to .*/map in 0.1 s"):
            await node.publisher("map", STRING).wait_for_reader(0.1, count=2)
        lasting = stock.create_publisher(
            String, node.full_name("log"), QoSProfile(depth=1, lifespan=Duration(seconds=10))
        )
        await until(lambda: node._ros.publishers(lasting.topic_name))
        assert node._ros.publishers(lasting.topic_name)[0].qos.lifespan == 10
        due = EndQos(deadline=0.5, liveliness="manual_by_topic", lease=2, lifespan=30)
        promised = node.publisher("promised", STRING, qos=due)
        wanted = QoSProfile(
            depth=1,
            deadline=Duration(seconds=0.1),
            liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
            liveliness_lease_duration=Duration(seconds=1),
        )
        stock.create_subscription(
            String, promised.topic, heard.append, wanted, event_callbacks=quiet
        )
        text = (
            "this publisher offers a deadline of 0.5 s, a lease of 2 s, and .*stock wants"
            " a deadline of 0.1 s, a lease of 1 s"
        )
        await until(lambda: any(end.node for end in node._ros.subscriptions(promised.topic)))
        with pytest.raises(TimeoutError, match=text):
            await promised.wait_for_reader(0.1)
        (own,) = node._ros.publishers(promised.topic)
        assert msgspec.structs.replace(own.qos, depth=10) == due
        fitting = QoSProfile(
            depth=1, deadline=Duration(seconds=1), liveliness=LivelinessPolicy.MANUAL_BY_TOPIC
        )
        stock.create_subscription(String, promised.topic, heard.append, fitting)
        await promised.wait_for_reader(PATIENCE)


async def test_services_are_found_with_their_types(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, stock):
        stock.create_service(ListParameters, node.full_name("theirs"), print)
        await until(lambda: dict(node._ros.services()).get(node.full_name("theirs")) == LIST)
        found = await node.settled(lambda view: dict(view.services()))
        assert found[node.full_name("theirs")] == LIST


def trusting(value: object) -> None:
    raise RuntimeError("cut")


def not_long(value: list[str]) -> None:
    if len(value) > 1:
        raise ValueError("too many")


async def test_values_of_parameters_have_their_types(scheme: str) -> None:
    async with beside_rclpy(scheme) as (node, _):
        own = node.parameters()
        with pytest.raises(ValueError, match="RuntimeError: cut"):
            own.declare("odd", 1, check=trusting)
        assert own.declare("flags", [True]) == [True]
        wrong: Any
        for wrong in ({}, [1, "a"]):
            with pytest.raises(TypeError, match="cannot be a parameter"):
                await own.set({"flags": wrong})
        await own.set({"flags": []})
        assert own["flags"] == []
        with pytest.raises(ValueError, match="there is no parameter 'nothing'"):
            await own.set({"flags": [], "nothing": 1})
        await own.set({"flags": [True]})
        with pytest.raises(TypeError, match="'frame' is a string: low and high are for numbers"):
            own.declare("frame", "base", low=1)
        with pytest.raises((TypeError, ValueError)):
            own.declare("unset", None)
        assert own.declare("names", [], is_read_only=True, check=not_long) == []
        assert own.declare("words", []) == []
        with pytest.raises(ValueError, match=r"\w"):
            await own.set({"names": ["a"]})
        await own.set({"words": ["a"]})
        assert own["words"] == ["a"]
        others = node.parameters(node.name, timeout=PATIENCE)
        assert await others.get("nothing", "flags") in (
            {"nothing": None, "flags": [True]},
            {"nothing": None, "flags": None},  # rclpy tells none if one is not declared
        )


async def test_what_is_not_installed_is_told() -> None:
    async with open_node("ros2://ours", arguments=[]) as node:
        for type_name, text in (
            ("std_msgs/msg/Nothing", "has no message 'Nothing'"),
            ("nothing_msgs/msg/String", "'nothing_msgs', which has .*, is not installed here"),
            ("std_msgs/String", "expected a type like 'package/msg/Type'"),
        ):
            with pytest.raises(TransportError, match=text):
                node.subscribe("topic", type_name)


async def test_nothing_is_begun_at_a_node_that_was_closed() -> None:
    async with open_node("ros2://ours", arguments=[]) as node:
        pass
    with pytest.raises(ConnectionLost, match="the node was closed here"):
        node.subscribe("chatter", STRING)


async def test_a_list_that_is_empty_by_default_has_the_value_of_the_arguments(scheme: str) -> None:
    words = ["--ros-args", "-p", "names:=[a, b]"]
    with anyio.fail_after(PATIENCE):
        async with open_node(f"{scheme}://ours", arguments=words) as node:
            assert node.parameters().declare("names", []) == ["a", "b"]
