"""A node of ROS over DDS, without ROS: a participant of RTPS, and the ends of its topics.

What arrives is handed over on the event loop, in the order in which it has arrived.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

from anyio.abc import TaskGroup

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import MESSAGE, clean_logger, excerpt
from fibaction.words.errors import TransportError
from fibaction_transports.ros2.node.graph_view import DiscoveryState
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    EndInfo,
    ErrorSink,
    MessageSink,
    RequestSink,
    ServiceCaller,
    ServiceProvider,
)
from fibaction_transports.ros2.node.ros_node import RosNode
from fibaction_transports.ros2.on_dds.clock import CLOCK_TOPIC, DdsClock
from fibaction_transports.ros2.on_dds.descriptions.description_messages import GET_TYPE_DESCRIPTION
from fibaction_transports.ros2.on_dds.descriptions.type_learner import TypeLearner, TypeQuestions
from fibaction_transports.ros2.on_dds.descriptions.type_registry import TypeRegistry
from fibaction_transports.ros2.on_dds.graph import DdsGraph, NodeName, dds_qos
from fibaction_transports.ros2.on_dds.messages.dds_types import DdsTypes
from fibaction_transports.ros2.on_dds.messages.message_type import (
    MessageType,
    ServiceType,
    reply_topic,
    request_topic,
    topic_name,
)
from fibaction_transports.ros2.on_dds.messages.node_messages import (
    CLOCK,
    LOG,
    ROSOUT,
    ROSOUT_QOS,
    RosoutLog,
)
from fibaction_transports.ros2.on_dds.parameters import DdsParameters
from fibaction_transports.ros2.on_dds.ros_arguments import NameResolver
from fibaction_transports.ros2.on_dds.services import DdsCaller, DdsProvider, ServiceEnds, provide
from fibaction_transports.ros2.on_dds.topics import (
    DdsLifeWatch,
    DdsPublisher,
    DdsSubscription,
)
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import (
    CaughtUp,
    Event,
    LivelinessChanged,
    ParticipantLost,
    SampleReceived,
    TypesAnswered,
)
from fibaction_transports.rtps.messages.ids import READER_KINDS, WRITER_KINDS, Guid
from fibaction_transports.rtps.network import ParticipantNetwork, open_network
from fibaction_transports.rtps.ports import DomainSettings
from fibaction_transports.rtps.qos import Qos

logger = clean_logger("fibaction.ros2")


class DdsNode(RosNode):
    """A node over DDS."""

    tells_signs = True

    def __init__(
        self,
        network: ParticipantNetwork,
        name: NodeName,
        resolver: NameResolver,
        types: DdsTypes,
        tasks: TaskGroup,
        *,
        has_rosout: bool,
    ) -> None:
        super().__init__()
        self.types = types
        self.clock = self._clock = DdsClock()
        self.parameters = DdsParameters(self._use_simulated_time)
        self.full_name = str(name)
        self.namespace = name.namespace
        self._resolver = resolver
        self.graph = DdsGraph(network, name)
        self.network = network
        """The participant with its sockets."""
        self._tasks = tasks
        self._takers: dict[Guid, Callable[[Sample], None]] = {
            self.graph.reader.guid: self.graph.receive
        }
        self._watches: dict[Guid, DdsLifeWatch] = {}
        self._subscriptions: dict[Guid, DdsSubscription] = {}
        self._simulated_time: DdsSubscription | None = None
        self._in_use = TypeRegistry()
        self._questions = TypeQuestions(network.ask_types)
        self._learner = TypeLearner(self, types, self._questions)
        self.parameters.serve(self, str(name))
        self._rosout = self._open_rosout() if has_rosout else None
        provide(self, f"{name}/get_type_description", GET_TYPE_DESCRIPTION, self._in_use.answer)
        tasks.start_soon(self.graph.run, name="announcements of a ROS node")

    # What arrives

    def handle(self, event: Event) -> None:
        """Handle an event of the participant."""
        if isinstance(event, SampleReceived):
            take = self._takers.get(event.reader)
            if take is None:
                return
            try:
                take(event.sample)
            except Exception:
                logger.exception("a message was dropped, because it could not be handled")
        elif isinstance(event, CaughtUp) and event.reader in self._subscriptions:
            self._subscriptions[event.reader].note_caught_up()
        elif isinstance(event, TypesAnswered):
            self._questions.take(event)
        elif isinstance(event, ParticipantLost):
            self.graph.forget(event.prefix)
        elif isinstance(event, LivelinessChanged) and event.reader in self._watches:
            self._watches[event.reader].note(event)

    # The node itself

    def resolve(self, name: str) -> str:
        return self._resolver.resolve(name)

    def warn(self, text: str) -> None:
        self._log(logging.WARNING, text)

    def complain(self, text: str) -> None:
        self._log(logging.ERROR, text)

    def _log(self, level: int, text: str) -> None:
        if self.is_up:
            line = excerpt(text, MESSAGE)
            logger.log(level, "%s", line)
            if self._rosout is not None:
                self._rosout.write(level, line)

    def _open_rosout(self) -> RosoutLog:
        writer = self._writer(topic_name(self.resolve(ROSOUT)), LOG, ROSOUT_QOS)
        publisher = DdsPublisher(writer, LOG, self.network.write)
        return RosoutLog(self.full_name, publisher.publish)

    def _use_simulated_time(self, wanted: bool) -> None:
        self._clock.use_simulated(wanted)
        if wanted and self._simulated_time is None:
            newest = EndQos(reliability="best_effort", depth=1)
            self._simulated_time = self.subscription(CLOCK_TOPIC, CLOCK, newest, self._clock.take)

    # Parts

    def publisher(self, topic: str, message_type: MessageType, qos: EndQos) -> DdsPublisher:
        writer = self._writer(topic_name(topic), message_type, dds_qos(qos))
        return DdsPublisher(writer, message_type, self.network.write)

    def subscription(
        self,
        topic: str,
        message_type: MessageType,
        qos: EndQos,
        take: MessageSink,
        *,
        is_first: bool = False,
    ) -> DdsSubscription:
        reader = self._reader(topic_name(topic), message_type, qos)
        subscription = DdsSubscription(reader, take, self.network.catch_up)
        self._subscriptions[reader.guid] = subscription
        self._takers[reader.guid] = subscription.receive
        return subscription

    def caller(
        self,
        service: str,
        service_type: ServiceType,
        qos: EndQos,
        take: AnswerSink,
        take_unreadable: ErrorSink | None = None,
    ) -> DdsCaller:
        # The reader first, so that a server that knows the writer knows where its answers go.
        reader = self._reader(reply_topic(service), service_type.Response, qos)
        writer = self._writer(request_topic(service), service_type.Request, dds_qos(qos))
        self._in_use.add_service(service_type)
        ends = ServiceEnds(self.network, writer, reader)
        caller = DdsCaller(ends, service_type, take, take_unreadable)
        self._takers[reader.guid] = caller.receive
        self._tasks.start_soon(caller.ask, name=f"client of {service}")
        return caller

    def remove_caller(self, caller: DdsCaller) -> None:
        """Remove a client of a service."""
        caller.close()
        self._takers.pop(caller.ends.reader.guid, None)
        for end in (caller.ends.writer, caller.ends.reader):
            self.graph.remove(end)
            self.network.remove(end)

    def provider(
        self, service: str, service_type: ServiceType, qos: EndQos, take: RequestSink
    ) -> DdsProvider:
        writer = self._writer(reply_topic(service), service_type.Response, dds_qos(qos))
        reader = self._reader(request_topic(service), service_type.Request, qos)
        self._in_use.add_service(service_type)
        provider = DdsProvider(ServiceEnds(self.network, writer, reader), service_type, take)
        self._takers[reader.guid] = provider.receive
        return provider

    def life_watch(self, topic: str, message_type: MessageType, qos: EndQos) -> DdsLifeWatch:
        reader = self._reader(topic_name(topic), message_type, qos)
        watch = self._watches[reader.guid] = DdsLifeWatch(reader)
        return watch

    def introspect(self, level: str, *services: ServiceCaller | ServiceProvider) -> None:
        if level != "off":
            raise TransportError(
                f"introspection={level!r} needs ROS itself: leave it out with dds://"
            )

    def _writer(self, topic: str, message_type: MessageType, qos: Qos) -> DataWriter:
        self._in_use.add_messages(message_type)
        made = self.network.create_writer(
            topic, message_type.dds_name, qos, user_data=message_type.user_data
        )
        self.graph.add(made)
        return made

    def _reader(self, topic: str, message_type: MessageType, qos: EndQos) -> DataReader:
        self._in_use.add_messages(message_type)
        made = self.network.create_reader(
            topic, message_type.dds_name, dds_qos(qos), user_data=message_type.user_data
        )
        self.graph.add(made)
        return made

    # The graph

    async def learn(self, actions: Sequence[tuple[str, str]]) -> None:
        await self._learner.learn(actions)

    def discovery(self) -> DiscoveryState:
        return self.graph.discovery()

    def nodes(self) -> set[str]:
        return self.graph.nodes()

    def topics(self) -> list[tuple[str, str]]:
        return self.graph.topics()

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return self.graph.publishers(topic)

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return self.graph.subscriptions(topic)

    def request_readers(self, service: str) -> Sequence[EndInfo]:
        return self.graph.readers(request_topic(service))

    def answer_writers(self, service: str) -> Sequence[EndInfo]:
        return self.graph.writers(reply_topic(service))

    def count_callers(self, service: str) -> int:
        return self.graph.count(request_topic(service), WRITER_KINDS)

    def count_publishers(self, topic: str) -> int:
        return self.graph.count(topic_name(topic), WRITER_KINDS)

    def count_subscriptions(self, topic: str) -> int:
        return self.graph.count(topic_name(topic), READER_KINDS)


class _Inbox:
    """The events of a participant, one after another even if one causes the next."""

    def __init__(self) -> None:
        self._events: deque[Event] = deque()
        self._handle: Callable[[Event], Any] | None = None
        self._is_busy = False

    def open(self, handle: Callable[[Event], Any]) -> None:
        """Handle the events that have come, and those that come."""
        self._handle = handle
        self.put()

    def put(self, *events: Event) -> None:
        """Handle events now, or after those that are being handled."""
        self._events += events
        if self._is_busy or self._handle is None:
            return
        self._is_busy = True
        try:
            while self._events:
                self._handle(self._events.popleft())
        finally:
            self._is_busy = False


@asynccontextmanager
async def open_node(
    domain: DomainSettings,
    name: NodeName,
    resolver: NameResolver,
    types: DdsTypes,
    *,
    network: Sequence[str] = (),
    fragment_size: int = 63_000,
    has_rosout: bool = True,
) -> AsyncGenerator[DdsNode, None]:
    """Open a node, and run it while the block is open; `network` and `fragment_size` are those of
    `DdsTransport`. With `has_rosout`, its log is published on `/rosout` as well.

    Raises:
        TransportError: The sockets cannot be opened.
    """
    inbox = _Inbox()
    opened = open_network(domain, inbox.put, interfaces=network, fragment_size=fragment_size)
    async with opened as participant, Background() as tasks:
        node = DdsNode(participant, name, resolver, types, tasks, has_rosout=has_rosout)
        inbox.open(node.handle)
        yield node
