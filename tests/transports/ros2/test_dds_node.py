"""A node over our own DDS: its parts, its parameters, its clock, and what it knows of others."""

from __future__ import annotations

import struct
import uuid
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import ConnectionLost, TransportError
from fibaction_transports.cdr.standard_messages import (
    GidMessage,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
)
from fibaction_transports.ros2.node.parts import EndInfo, LifeSigns
from fibaction_transports.ros2.on_dds import graph, topics
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsNode, DdsSettings, _Inbox
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.descriptions.described_types import UnusableDescription
from fibaction_transports.ros2.without_ros.messages import node_messages as messages
from fibaction_transports.ros2.without_ros.messages.action_types import standard_type
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    CLOCK,
    PARAMETER,
    ClockMessage,
    Parameter,
)
from fibaction_transports.ros2.without_ros.own_node import OwnClock
from fibaction_transports.rtps.discovery.type_lookup import TYPE_ID_SIZE
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.events import ParticipantLost, TypesAnswered
from fibaction_transports.rtps.messages.ids import FAST_DDS, Guid
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.processes import PATIENCE
from tests.support.until import until

pytestmark = pytest.mark.anyio

KEPT = EndQos(durability="transient_local", depth=5)


@asynccontextmanager
async def opened(
    name: str = "", *arguments: str, namespace: str = "", **settings: Any
) -> AsyncGenerator[DdsNode, None]:
    node = NodeSettings(name, namespace, None, ["--ros-args", *arguments])
    with anyio.fail_after(PATIENCE):
        async with DdsAdapter(node, DdsSettings(**settings)).open() as found:
            yield found


class Answers:
    """A client of a service of another node."""

    def __init__(self, node: DdsNode, service: str, service_type: Any) -> None:
        self._news = anyio.Event()
        self._answer: Any = None
        self._caller = node.caller(service, service_type, EndQos(), self._take)

    def _take(self, number: int, response: Any) -> None:
        self._answer = response
        self._news.set()

    async def call(self, request: Any) -> Any:
        await until(self._caller.is_available, True)
        self._news = anyio.Event()
        self._caller.send(request)
        await self._news.wait()
        return self._answer


async def test_a_message_reaches_a_subscription_with_the_id_of_its_publisher() -> None:
    heard: list[tuple[bytes, bytes]] = []
    topic = f"/t{uuid.uuid4().hex}"
    async with opened() as one, opened() as other:
        publisher = one.publisher(topic, PARAMETER, KEPT)
        publisher.publish(Parameter("first"))
        subscription = other.subscription(
            topic, PARAMETER, KEPT, lambda message, gid: heard.append((message, gid))
        )
        await until(lambda: len(heard), 1)
        await until(publisher.reader_count, 1)
        publisher.publish_bytes(PARAMETER.codec.encode(Parameter("second")))
        await until(lambda: len(heard), 2)
        assert [one.types.decode(message, PARAMETER).name for message, _ in heard] == [
            "first",
            "second",
        ]
        (end,) = other.publishers(topic)
        assert {gid for _, gid in heard} == {end.gid}
        assert end.qos == EndQos(durability="transient_local", depth=5)
        assert subscription.publisher_count() == 1
        assert (topic, "rcl_interfaces/msg/Parameter") in other.topics()
        assert (topic, "rcl_interfaces/msg/Parameter") in one.topics()


async def test_messages_have_arrived_when_readers_of_our_own_have_acknowledged_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    topic = f"/t{uuid.uuid4().hex}"
    async with opened() as one, opened() as other:
        publisher = one.publisher(topic, PARAMETER, EndQos())
        other.subscription(topic, PARAMETER, EndQos(), lambda message, gid: None)
        await until(publisher.reader_count, 1)
        publisher.publish(Parameter("one"))
        await until(lambda: publisher.has_arrived(0), True)
        # The queue of a reader of another maker may overflow, whatever it has acknowledged.
        monkeypatch.setattr(topics, "OWN_VENDOR", FAST_DDS)
        assert not publisher.has_arrived(0)


async def test_a_sink_that_fails_is_logged_and_the_next_message_arrives(
    caplog: pytest.LogCaptureFixture,
) -> None:
    heard: list[bytes] = []

    def take(message: bytes, gid: bytes) -> None:
        heard.append(message)
        if len(heard) == 1:
            raise RuntimeError("not this one")

    topic = f"/t{uuid.uuid4().hex}"
    async with opened() as one, opened() as other:
        publisher = one.publisher(topic, PARAMETER, KEPT)
        other.subscription(topic, PARAMETER, KEPT, take)
        for name in ("a", "b"):
            publisher.publish(Parameter(name))
        await until(lambda: len(heard), 2)
    assert "a message was dropped, because it could not be handled" in caplog.text


async def test_an_answer_about_types_reaches_the_question(monkeypatch: pytest.MonkeyPatch) -> None:
    prefix, type_id, problem = bytes(12), bytes(TYPE_ID_SIZE), "it does not tell"

    async def ask(node: DdsNode) -> None:
        with pytest.raises(UnusableDescription, match=problem):
            await node._questions.look_up([EndInfo(prefix, "/far", EndQos(), type_id=type_id)], "")

    async with opened() as node, anyio.create_task_group() as tasks:
        monkeypatch.setattr(node._questions, "_ask", lambda *_: 7)
        tasks.start_soon(ask, node)
        await until(lambda: 7 in node._questions._waiting, True)
        node.handle(TypesAnswered(prefix, 7, bytes(4)))


async def test_a_message_that_does_not_fit_into_the_history_is_lost(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with opened() as node:
        publisher = node.publisher(f"/t{uuid.uuid4().hex}", PARAMETER, KEPT)
        publisher.publish_bytes(bytes(65 * 2**20))
    assert "a message is lost" in caplog.text


async def test_the_nodes_of_ends_are_known() -> None:
    name = f"n{uuid.uuid4().hex}"
    async with opened(name, namespace="robot") as one, opened() as other:
        topic = f"/{name}"
        one.publisher(topic, PARAMETER, EndQos(reliability="best_effort", lease=2.0))
        await until(lambda: [end.node for end in other.publishers(topic)], [f"/robot/{name}"])
        (end,) = other.publishers(topic)
        assert end.qos == EndQos(reliability="best_effort", lease=2.0)
        assert [end.node for end in one.publishers(topic)] == [f"/robot/{name}"]
        service = f"/robot/{name}/get_parameters"
        await until(
            lambda: [end.node for end in other.request_readers(service)], [f"/robot/{name}"]
        )
        await until(lambda: [end.node for end in other.answer_writers(service)], [f"/robot/{name}"])
        assert other.count_callers(service) == 0
        assert other.subscriptions(topic) == []
        await until(lambda: bool(other.graph._nodes), True)


async def test_what_another_participant_tells_of_its_nodes_is_bounded(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(graph, "MOST_ENTITIES", 2)
    caplog.set_level("INFO")
    codec = standard_type("ParticipantEntitiesInfo").codec
    prefix = b"p" * 12

    def told(*entities: int, name: str = "n") -> Sample:
        gids = [GidMessage(prefix + bytes([0, 0, entity, 4])) for entity in entities]
        info = ParticipantEntitiesInfo(
            GidMessage(prefix + bytes(4)), [NodeEntitiesInfo("/", name, gids, [])]
        )
        return Sample(Guid(prefix + bytes(4)), 1, codec.encode(info))

    async with opened() as node:
        found = node.graph
        found.receive(told(1, 2))
        assert set(found._nodes[prefix].values()) == {"/n"}
        found.receive(told(1, 2, 3, name="many"))
        assert set(found._nodes[prefix].values()) == {"/n"}
        found.receive(Sample(Guid(prefix + bytes(4)), 1, b"\0\1\0\0"))
        assert "cannot be read" in caplog.text
        found.forget(prefix)
        found.forget(prefix)
        assert prefix not in found._nodes


async def test_signs_of_life_are_counted() -> None:
    topic = f"/t{uuid.uuid4().hex}"
    alive = EndQos(reliability="best_effort", lease=0.3)
    async with opened() as one:
        watch = one.life_watch(topic, PARAMETER, alive)
        assert watch.news() is None
        async with opened() as other:
            other.publisher(topic, PARAMETER, alive)
            await until(watch.news, LifeSigns(1, 0))
            assert watch.news() is None
            network = other.network.participant
            network._shared.timers.clear()  # it is there, and gives no sign of life
            await until(watch.news, LifeSigns(0, 1))
            network._assertions.plan(anyio.current_time())
            other.network.settle()
            await until(watch.news, LifeSigns(1, 0))
        await until(watch.news, LifeSigns(0, 0))


async def test_the_time_of_a_simulation_is_that_of_its_topic() -> None:
    async with opened("", "-p", "use_sim_time:=true") as node, opened() as simulator:
        assert node.clock.now() == 0
        time = simulator.publisher("/clock", CLOCK, KEPT)
        await until(time.reader_count, 1)
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = 12, 5

        def told() -> int:
            time.publish(message)  # until the reader knows the writer, it takes nothing of it
            return node.clock.now()

        await until(told, 12 * 10**9 + 5)
        for wanted in (False, True, True):
            node.parameters.set_values({"use_sim_time": wanted})
        assert node.clock.era == 3


def clock_message(seconds: int, order: str = "<") -> bytes:
    return bytes([0, order == "<", 0, 0]) + struct.pack(f"{order}iI", seconds, 0)


def test_a_clock_that_jumps_back_begins_an_era() -> None:
    clock = OwnClock()
    assert clock.is_the_machines
    clock.use_simulated(True)
    for seconds in (5, 7):
        clock.take(clock_message(seconds), b"")
    assert (clock.now(), clock.era) == (7 * 10**9, 1)
    clock.take(clock_message(3, ">"), b"")
    assert (clock.now(), clock.era) == (3 * 10**9, 2)
    for invalid in (b"", b"\0\1\0\0", clock_message(9)[:-1], b"\0\7" + clock_message(9)[2:]):
        clock.take(invalid, b"")
    assert clock.now() == 3 * 10**9
    assert not clock.is_the_machines


async def test_a_request_that_cannot_be_answered_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    name = f"n{uuid.uuid4().hex}"
    async with opened(name) as node, opened() as other:
        answers = Answers(other, f"/{name}/list_parameters", messages.LIST_PARAMETERS)
        await answers.call(messages.ListRequest())
        for writer in node.network.participant._local.user_writers():
            writer.readers.clear()  # as if the answer's reader was not discovered yet
        answers._caller.send(messages.ListRequest())
        await until(lambda: "an answer cannot reach its client, and is lost" in caplog.text, True)


async def test_introspection_needs_ros() -> None:
    async with opened() as node:
        node.introspect("off")
        with pytest.raises(TransportError, match="introspection='contents' needs ROS itself"):
            node.introspect("contents")


async def test_a_node_that_has_failed_says_so_once_and_logs_nothing_more(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lost: list[str] = []
    async with opened() as node:
        node.on_loss(lambda error: lost.append(str(error)))
        node.warn("careful")
        node.complain("wrong")
        assert node.is_up
        for reason in ("closed", "closed again"):
            node.fail(ConnectionLost(reason))
        node.warn("too late")
        assert not node.is_up
    assert lost == ["closed"]
    assert [record.getMessage() for record in caplog.records] == ["careful", "wrong"]


async def test_the_domain_and_the_range_may_be_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    node = NodeSettings("", "", 7, [])
    settings = DdsSettings(discovery="SUBNET", peers=("one", "two"))
    domain = DdsAdapter(node, settings).domain()
    assert (domain.domain, domain.discovery_range.value) == (7, "SUBNET")
    assert domain.static_peers == ("one", "two")
    assert domain.ip_versions == (4,)
    assert DdsAdapter(node, DdsSettings(ip_versions=(6,))).domain().ip_versions == (6,)
    assert DdsAdapter(node, DdsSettings(peers=("fd00::7",))).domain().ip_versions == (4, 6)
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(TransportError, match="ROS_DOMAIN_ID='many'"):
        DdsAdapter(NodeSettings(), DdsSettings()).domain()


def test_an_event_that_another_one_causes_is_handled_after_it() -> None:
    handled: list[object] = []
    inbox = _Inbox()

    def handle(event: object) -> None:
        if event == FIRST:
            inbox.put(SECOND)
        handled.append(event)

    inbox.put(FIRST)
    assert handled == []
    inbox.open(handle)
    assert handled == [FIRST, SECOND]


FIRST, SECOND = (ParticipantLost(bytes([number]) * 12, has_left=True) for number in (1, 2))
