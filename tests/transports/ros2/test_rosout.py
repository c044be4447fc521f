"""The log of a node over our own DDS, as other nodes read it on `/rosout`."""

from __future__ import annotations

import logging
import time
import uuid

import pytest

from fibaction_transports.ros2.on_dds.node import DdsNode
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.node_messages import LOG, LogMessage
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.until import until
from tests.transports.ros2.test_dds_node import opened

pytestmark = pytest.mark.anyio

HASH_OF_ROS = "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac"
TYPE = "rcl_interfaces/msg/Log"
LATE = EndQos(durability="transient_local", depth=100)


@pytest.fixture
def name() -> str:
    return f"n{uuid.uuid4().hex}"


def read(node: DdsNode, logger: str, topic: str = "/rosout") -> list[LogMessage]:
    """Return the list to which the lines of one logger go from now on."""
    heard: list[LogMessage] = []

    def take(message: bytes, publisher: bytes) -> None:
        line = node.types.decode(message, LOG)
        if line.name == logger:
            heard.append(line)

    node.subscription(topic, LOG, LATE, take)
    return heard


def test_the_type_is_that_of_ros() -> None:
    assert LOG.type_hash == HASH_OF_ROS


async def test_a_node_that_comes_late_reads_what_another_has_logged(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    before = time.time()
    async with opened(name, namespace="robot/left") as node, opened() as other:
        node.warn("careful")
        node.complain("wrong")
        heard = read(other, f"robot.left.{name}")
        await until(lambda: len(heard), 2)
        (end,) = [end for end in other.publishers("/rosout") if end.gid[:12] == prefix_of(node)]
    assert [(line.level, line.msg) for line in heard] == [
        (logging.WARNING, "careful"),
        (logging.ERROR, "wrong"),
    ]
    assert all(before - 1 < line.stamp.sec < time.time() + 1 for line in heard)
    assert (end.qos.reliability, end.qos.durability, end.qos.depth) == (
        "reliable",
        "transient_local",
        1000,
    )
    assert [record.getMessage() for record in caplog.records] == ["careful", "wrong"]


def prefix_of(node: DdsNode) -> bytes:
    return node.network.participant.prefix


async def test_the_topic_may_have_another_name(name: str) -> None:
    async with opened(name, "-r", f"/rosout:=/{name}/log") as node, opened() as other:
        node.warn("careful")
        heard = read(other, name, f"/{name}/log")
        await until(lambda: len(heard), 1)
        assert (f"/{name}/log", TYPE) in node.topics()


async def test_with_disable_rosout_logs_other_nodes_read_nothing(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with opened(name, "--disable-rosout-logs") as node:
        node.warn("careful")
        assert not node.publishers("/rosout")
    assert [record.getMessage() for record in caplog.records] == ["careful"]
