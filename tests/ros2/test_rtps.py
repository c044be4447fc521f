"""Participants of our RTPS, which need no ROS, and unmodified nodes of rclpy.

Payloads are bytes here: an encapsulation header, and the message as CDR in little-endian.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Callable

import pytest
from rcl_interfaces.srv import GetParameterTypes
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from fibaction_transports.ros2.on_rclpy.rcl import middleware
from fibaction_transports.rtps.events import (
    EndpointMatched,
    EndpointUnmatched,
    QosMismatch,
    SampleReceived,
)
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS, FAST_DDS
from fibaction_transports.rtps.messages.parameters import (
    FAST_DDS_RELATED_SAMPLE_IDENTITY,
    RELATED_SAMPLE_IDENTITY,
    SampleIdentity,
    identity_value,
)
from fibaction_transports.rtps.qos import Durability, Qos
from tests.ros2.spun import spun_node
from tests.ros2.stock.process import peer
from tests.ros2.stock.waiting import eventually
from tests.support.rtps_end import TEXT, RtpsEnd, rtps_end, text, text_of

pytestmark = pytest.mark.anyio

LITTLE = b"\x00\x01\x00\x00"
ACTION = "arduinobot_msgs::action::dds_::Fibonacci_"
UNKNOWN = -(2**32)
"""The number of a request that the reply is to name itself."""


of_fast_dds = pytest.mark.skipif(
    "fastrtps" not in middleware(), reason="only Fast DDS has the identity in the inline QoS"
)


def ints(content: bytes) -> list[int]:
    (count,) = struct.unpack_from("<I", content)
    return list(struct.unpack_from(f"<{count}i", content, 4))


async def seen(look: Callable[[], object], expected: object) -> None:
    """Wait until a node in another thread shows what is expected."""

    async def look_once() -> object:
        return look()

    await eventually(look_once, lambda shown: shown == expected)


async def test_topics_of_a_stock_node_are_read_and_written() -> None:
    name = f"t{uuid.uuid4().hex}"
    heard: list[str] = []
    profile = QoSProfile(depth=100)
    sent = ["a", "b" * 1_000_000, "c"]
    with spun_node("/") as node:
        node.create_subscription(String, f"{name}/in", lambda m: heard.append(m.data), profile)
        publisher = node.create_publisher(String, f"{name}/out", profile)
        async with rtps_end() as found:
            network = found.network
            writer = network.create_writer(f"rt/{name}/in", TEXT, Qos(depth=None))
            reader = network.create_reader(f"rt/{name}/out", TEXT, Qos())
            await found.until(lambda: len(found.all(EndpointMatched)) == 2)
            (remote,) = writer.readers
            vendor = CYCLONE_DDS if "cyclonedds" in middleware() else FAST_DDS
            assert network.participant.vendor_of(remote.prefix) == vendor
            await seen(publisher.get_subscription_count, 1)
            for each in sent:
                network.write(writer, text(each))
                publisher.publish(String(data=each))
            await found.until(lambda: len(found.payloads(reader)) == 3)
            assert [text_of(payload) for payload in found.payloads(reader)] == sent
            await seen(lambda: heard, sent)
            assert network.participant.counters.invalid == 0
        await seen(publisher.get_subscription_count, 0)


async def test_a_late_reader_gets_what_a_stock_node_keeps_and_the_other_way_round() -> None:
    name = f"t{uuid.uuid4().hex}"
    heard: list[str] = []
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
    with spun_node("/") as node:
        publisher = node.create_publisher(String, f"{name}/out", profile)
        for each in ("old", "kept"):
            publisher.publish(String(data=each))
        async with rtps_end() as found:
            writer = found.network.create_writer(f"rt/{name}/in", TEXT, late)
            for each in ("old", "kept by us"):
                found.network.write(writer, text(each))
            reader = found.network.create_reader(f"rt/{name}/out", TEXT, late)
            await found.until(lambda: bool(found.payloads(reader)))
            assert [text_of(payload) for payload in found.payloads(reader)] == ["kept"]
            node.create_subscription(
                String, f"{name}/in", lambda message: heard.append(message.data), profile
            )
            await seen(lambda: heard, ["kept by us"])
            node.destroy_publisher(publisher)
            await found.until(lambda: bool(found.all(EndpointUnmatched)))


# rclpy notices it, too, and logs it in a way of its own that is deprecated.
@pytest.mark.filterwarnings("ignore:Deprecated in favor of:DeprecationWarning")
async def test_a_mismatch_with_a_stock_node_is_told_with_its_reasons() -> None:
    name = f"t{uuid.uuid4().hex}"
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    with spun_node("/") as node:
        node.create_publisher(String, name, profile)
        async with rtps_end() as found:
            found.network.create_reader(f"rt/{name}", TEXT, Qos())
            await found.until(lambda: bool(found.all(QosMismatch)))
            (mismatch,) = found.all(QosMismatch)
            assert mismatch.reasons == (
                "reliability: the writer offers best_effort, the reader requests reliable",
            )


class RawService:
    """A client of a service: requests and replies as bytes."""

    def __init__(self, found: RtpsEnd, name: str, type_name: str) -> None:
        self._found = found
        create_reader, create_writer = found.network.create_reader, found.network.create_writer
        self.reader = create_reader(f"rr/{name}Reply", f"{type_name}Response_", Qos())
        self.writer = create_writer(f"rq/{name}Request", f"{type_name}Request_", Qos(depth=None))

    @property
    def is_ready(self) -> bool:
        return bool(self.reader.writers and self.writer.readers)

    async def call(self, request: bytes) -> bytes:
        """Return the reply, without its encapsulation header."""
        own = identity_value(SampleIdentity(self.reader.guid, UNKNOWN))
        number = self._found.network.write(
            self.writer,
            LITTLE + request,
            inline_qos=[(FAST_DDS_RELATED_SAMPLE_IDENTITY, own), (RELATED_SAMPLE_IDENTITY, own)],
        )
        expected = SampleIdentity(self.reader.guid, number)
        await self._found.until(lambda: bool(self._replies(expected)))
        (reply,) = self._replies(expected)
        return reply

    def _replies(self, expected: SampleIdentity) -> list[bytes]:
        return [
            event.sample.payload[4:]
            for event in self._found.all(SampleReceived)
            if event.reader == self.reader.guid
            and event.sample.inline_qos is not None
            and event.sample.inline_qos.identity(RELATED_SAMPLE_IDENTITY) == expected
        ]


@of_fast_dds
async def test_a_goal_of_raw_bytes_runs_at_a_stock_action_server() -> None:
    async with peer("server"), rtps_end() as found:
        send = RawService(found, "stock/_action/send_goal", f"{ACTION}SendGoal_")
        get = RawService(found, "stock/_action/get_result", f"{ACTION}GetResult_")
        feedback = found.network.create_reader(
            "rt/stock/_action/feedback", f"{ACTION}FeedbackMessage_", Qos()
        )
        await found.until(lambda: send.is_ready and get.is_ready and bool(feedback.writers))
        heard: list[bytes] = []
        while not heard:  # the server may find the reader of feedback late
            goal = uuid.uuid4().bytes
            accepted = await send.call(goal + struct.pack("<i", 9))
            assert accepted[0] == 1
            outcome = await get.call(goal)
            assert outcome[0] == 4  # succeeded
            assert ints(outcome[4:]) == [0, 1, 1, 2, 3, 5, 8, 13, 21, 34]
            heard = [payload for payload in found.payloads(feedback) if payload[4:20] == goal]
        assert ints(heard[0][20:]) == [0, 1, 1]
        rejected = await send.call(uuid.uuid4().bytes + struct.pack("<i", -1))
        assert rejected[0] == 0


@of_fast_dds
async def test_requests_of_two_stock_clients_are_each_answered_to_their_client_only() -> None:
    service = f"t{uuid.uuid4().hex}"
    type_name = "rcl_interfaces::srv::dds_::GetParameterTypes_"
    with spun_node("/", "one") as one, spun_node("/", "other") as other:
        clients = [node.create_client(GetParameterTypes, service) for node in (one, other)]
        async with rtps_end() as found:
            network = found.network
            requests = network.create_reader(f"rq/{service}Request", f"{type_name}Request_", Qos())
            replies = network.create_writer(
                f"rr/{service}Reply", f"{type_name}Response_", Qos(depth=None)
            )
            for client in clients:
                await seen(client.service_is_ready, True)
            await found.until(lambda: len(replies.readers) == len(requests.writers) == 2)
            calls = [
                (name, client.call_async(GetParameterTypes.Request(names=[name])))
                for name in ("a", "bcd", "efghi")
                for client in clients
            ]
            await found.until(lambda: len(found.payloads(requests)) == len(calls))
            for event in found.all(SampleReceived):
                sample = event.sample
                assert sample.inline_qos is not None
                identity = sample.inline_qos.identity(RELATED_SAMPLE_IDENTITY)
                assert identity is not None
                client_reader = identity.writer
                assert client_reader in replies.readers
                related = identity_value(SampleIdentity(client_reader, sample.number))
                name = text_of(LITTLE + sample.payload[8:])
                network.write(
                    replies,
                    LITTLE + struct.pack("<IB", 1, len(name)),
                    inline_qos=[
                        (FAST_DDS_RELATED_SAMPLE_IDENTITY, related),
                        (RELATED_SAMPLE_IDENTITY, related),
                    ],
                    only_to=client_reader,
                )
            for name, future in calls:
                await seen(future.done, True)
                assert list(future.result().types) == [len(name)]
            await seen(lambda: replies.kept, 0)
