"""Topics beside stock nodes: each primitive, late readers, large ones, many, and a bad network."""

from __future__ import annotations

import random
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from queue import Queue
from typing import Any

import msgspec
import pytest
from hypothesis import Phase, given, settings
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String, UInt8MultiArray

from fibaction.interfaces.files import InterfaceMessage, read_message
from fibaction.interfaces.packages import SearchPath
from fibaction.interfaces.structs import structs_of
from fibaction.types.ros_messages import encode
from tests.lossy.bad_network import Weather, bad_network
from tests.ros2.spun import beside_rclpy
from tests.support.until import until
from tests.transports.cdr.generated import values_of

pytestmark = [pytest.mark.anyio, pytest.mark.timeout(120)]

PATIENCE = 60.0
SHARE = Path(sys.prefix, "share")
TYPES = [
    *(
        f"test_msgs/msg/{name}"
        for name in (
            *("Arrays", "BasicTypes", "BoundedPlainSequences", "BoundedSequences", "Builtins"),
            *("Constants", "Defaults", "Empty", "MultiNested", "Nested", "Strings"),
            *("UnboundedSequences", "WStrings"),
        )
    ),
    "fibaction_test_msgs/msg/Part",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "std_msgs/msg/UInt8MultiArray",
    "tf2_msgs/msg/TFMessage",
    "trajectory_msgs/msg/JointTrajectory",
]
VALUES = 3
"""Values of each type."""
KEPT = QoSProfile(depth=3, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = 100


@cache
def some_values(type_name: str) -> list[Any]:
    """Return values of a message, those of hypothesis without its first and simplest ones."""
    found: list[Any] = []
    message = read_message(type_name, SearchPath((SHARE,), ()))
    structs = structs_of([*_nested(message)])

    @settings(max_examples=2 * VALUES, phases=[Phase.generate], database=None, derandomize=True)
    @given(values_of(message, structs))
    def collect(value: Any) -> None:
        found.append(value)

    collect()
    return found[-VALUES:]


def _nested(message: InterfaceMessage) -> list[InterfaceMessage]:
    return [*(one for part in message.nested.values() for one in _nested(part)), message]


def plain(message: Any) -> Any:
    return msgspec.msgpack.decode(encode(message))


@pytest.mark.filterwarnings("ignore:Generating overly large repr")
async def test_twenty_types_with_each_primitive_go_both_ways(scheme: str) -> None:
    async with beside_rclpy(scheme, PATIENCE) as (node, stock):
        for number, type_name in enumerate(TYPES):
            package, _, name = type_name.split("/")
            cls = getattr(import_module(f"{package}.msg"), name)
            there, back = f"there{number}", f"back{number}"
            echo = stock.create_publisher(cls, node.full_name(back), 10)
            stock.create_subscription(cls, node.full_name(there), echo.publish, 10)
            with node.subscribe(back, type_name) as heard, node.publisher(there, type_name) as told:
                await until(lambda: told.reader_count() and heard.publisher_count())
                await until(echo.get_subscription_count)
                for value in some_values(type_name):
                    await told.publish(value)
                    assert plain(await heard.next()) == plain(value), type_name


async def test_a_late_reader_gets_what_was_published_before_also_eight_megabytes(
    scheme: str,
) -> None:
    large = random.Random(1).randbytes(8_000_000)
    async with beside_rclpy(scheme, PATIENCE) as (node, stock):
        words = node.publisher("words", "std_msgs/msg/String", qos="transient_local", depth=3)
        blobs = node.publisher(
            "blobs", "std_msgs/msg/UInt8MultiArray", qos="transient_local", depth=1
        )
        for word in "abcde":
            await words.publish({"data": word})
        await blobs.publish({"data": large})
        heard: Queue[Any] = Queue()
        for cls, topic in ((String, "words"), (UInt8MultiArray, "blobs")):
            stock.create_subscription(cls, node.full_name(topic), heard.put, KEPT)
        await until(lambda: heard.qsize() == 4)
        found = [heard.get() for _ in range(4)]
        assert [one.data for one in found if isinstance(one, String)] == [*"cde"]
        assert [bytes(one.data) for one in found if not isinstance(one, String)] == [large]

        theirs = stock.create_publisher(String, node.full_name("back"), KEPT)
        blob = stock.create_publisher(UInt8MultiArray, node.full_name("blob_back"), KEPT)
        for word in "vwxyz":
            theirs.publish(String(data=word))
        blob.publish(UInt8MultiArray(data=large))
        late = node.subscribe("back", "std_msgs/msg/String", qos="transient_local")
        assert [(await late.next()).data for _ in range(3)] == [*"xyz"]
        back = node.subscribe("blob_back", "std_msgs/msg/UInt8MultiArray", qos="transient_local")
        assert bytes((await back.next()).data) == large


async def test_a_hundred_topics_each_way(scheme: str) -> None:
    async with beside_rclpy(scheme, PATIENCE) as (node, stock):
        ends = []
        for number in range(TOPICS):
            echo = stock.create_publisher(String, node.full_name(f"back{number}"), 10)
            stock.create_subscription(String, node.full_name(f"there{number}"), echo.publish, 10)
            told = node.publisher(f"there{number}", "std_msgs/msg/String")
            heard = node.subscribe(f"back{number}", "std_msgs/msg/String")
            ends.append((told, heard, echo))
        for number, (told, heard, echo) in enumerate(ends):
            await until(lambda: told.reader_count() and heard.publisher_count())  # noqa: B023
            await until(echo.get_subscription_count)
            await told.publish({"data": str(number)})
        assert [(await heard.next()).data for _, heard, _ in ends] == [*map(str, range(TOPICS))]


async def test_nothing_is_lost_over_a_network_that_loses_a_tenth() -> None:
    words = [str(number) for number in range(300)]
    with bad_network(Weather(0.1), seed=1, inwards=True):
        async with beside_rclpy("dds") as (node, stock):
            deep = QoSProfile(depth=len(words))
            echo = stock.create_publisher(String, node.full_name("back"), deep)
            stock.create_subscription(String, node.full_name("there"), echo.publish, deep)
            told = node.publisher("there", "std_msgs/msg/String", depth=len(words))
            heard = node.subscribe("back", "std_msgs/msg/String", depth=len(words))
            await until(lambda: told.reader_count() and heard.publisher_count())
            await until(echo.get_subscription_count)
            for word in words:
                await told.publish({"data": word})
            assert [(await heard.next()).data for _ in words] == words
