"""A node of ROS over DDS, without ROS: a participant of RTPS, and the ends of its topics.

What arrives is handed over on the event loop, in the order in which it has arrived.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

from anyio.abc import TaskGroup

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.node.mailbox import Drops
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    ErrorSink,
    MessageSink,
    NodePart,
    RequestSink,
    UnansweredSink,
)
from fibaction_transports.ros2.on_dds.graph import DdsGraph, dds_qos
from fibaction_transports.ros2.on_dds.services import DdsCaller, DdsProvider, ServiceEnds
from fibaction_transports.ros2.on_dds.topics import (
    DdsLifeWatch,
    DdsPublisher,
    DdsSubscription,
    reply_topic,
    request_topic,
    topic_name,
)
from fibaction_transports.ros2.on_dds.type_questions import TypeQuestions
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.own_node import NodeStart, OwnNode
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import (
    CaughtUp,
    EndpointUnmatched,
    Event,
    LivelinessChanged,
    ParticipantLost,
    SampleReceived,
    TypesAnswered,
)
from fibaction_transports.rtps.messages.ids import Guid
from fibaction_transports.rtps.network import ParticipantNetwork, open_network
from fibaction_transports.rtps.ports import DomainSettings

logger = clean_logger("fibaction.ros2")


class DdsNode(OwnNode):
    """A node over DDS."""

    tells_signs = True
    scheme = "dds"

    def __init__(
        self,
        network: ParticipantNetwork,
        start: NodeStart,
        types: FileTypes,
        tasks: TaskGroup,
    ) -> None:
        self.graph = DdsGraph(network, start.name)
        self.network = network
        """The participant with its sockets."""
        self._tasks = tasks
        self._drops = Drops("a message")
        self._takers: dict[Guid, Callable[[Sample], None]] = {
            self.graph.reader.guid: self.graph.receive
        }
        self._watches: dict[Guid, DdsLifeWatch] = {}
        self._subscriptions: dict[Guid, DdsSubscription] = {}
        self._questions = TypeQuestions(network.ask_types)
        super().__init__(self.graph, start, types, self._questions)
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
            except ProtocolError as exc:
                self._drops.note(exc)
            except Exception:
                logger.exception("a message was dropped, because it could not be handled")
        elif isinstance(event, CaughtUp) and event.reader in self._subscriptions:
            self._subscriptions[event.reader].note_caught_up()
        elif isinstance(event, EndpointUnmatched) and event.local in self._subscriptions:
            self._subscriptions[event.local].forget(event.remote)
        elif isinstance(event, TypesAnswered):
            self._questions.take(event)
        elif isinstance(event, ParticipantLost):
            self.graph.forget(event.prefix)
        elif isinstance(event, LivelinessChanged) and event.reader in self._watches:
            self._watches[event.reader].note(event)

    # Parts

    def publisher(self, topic: str, message_type: MessageType, qos: EndQos) -> DdsPublisher:
        writer = self._writer(topic_name(topic), message_type, qos)
        return DdsPublisher(writer, message_type, self.network.write, qos.room)

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
        subscription = DdsSubscription(reader, take, self.network.catch_up, self.network.pause)
        self._subscriptions[reader.guid] = subscription
        self._listen(reader, subscription.receive)
        return subscription

    def caller(
        self,
        service: str,
        service_type: ServiceType,
        qos: EndQos,
        take: AnswerSink,
        take_unreadable: ErrorSink | None = None,
        take_unanswered: UnansweredSink | None = None,
    ) -> DdsCaller:
        # The reader first, so that a server that knows the writer knows where its answers go.
        reader = self._reader(reply_topic(service), service_type.Response, qos)
        writer = self._writer(request_topic(service), service_type.Request, qos)
        self.in_use.add_service(service_type)
        ends = ServiceEnds(self.network, writer, reader)
        caller = DdsCaller(ends, service_type, take, take_unreadable)
        self._listen(reader, caller.receive)
        self._tasks.start_soon(caller.ask, name=f"client of {service}")
        return caller

    def provider(
        self, service: str, service_type: ServiceType, qos: EndQos, take: RequestSink
    ) -> DdsProvider:
        writer = self._writer(reply_topic(service), service_type.Response, qos)
        reader = self._reader(request_topic(service), service_type.Request, qos)
        self.in_use.add_service(service_type)
        provider = DdsProvider(ServiceEnds(self.network, writer, reader), service_type, take)
        self._listen(reader, provider.receive)
        return provider

    def life_watch(self, topic: str, message_type: MessageType, qos: EndQos) -> DdsLifeWatch:
        reader = self._reader(topic_name(topic), message_type, qos)
        watch = self._watches[reader.guid] = DdsLifeWatch(reader)
        self.network.match_own(reader)
        return watch

    def remove(self, part: NodePart) -> None:
        if isinstance(part, DdsCaller):
            part.close()
        for end in _ends_of(part):
            self._takers.pop(end.guid, None)
            self._subscriptions.pop(end.guid, None)
            self._watches.pop(end.guid, None)
            self.graph.remove(end)
            self.network.remove(end)

    def _writer(self, topic: str, message_type: MessageType, qos: EndQos) -> DataWriter:
        self.in_use.add_messages(message_type)
        made = self.network.create_writer(
            topic, message_type.dds_name, dds_qos(qos), user_data=message_type.user_data
        )
        self.graph.add(made)
        self.network.match_own(made)
        return made

    def _reader(self, topic: str, message_type: MessageType, qos: EndQos) -> DataReader:
        self.in_use.add_messages(message_type)
        made = self.network.create_reader(
            topic, message_type.dds_name, dds_qos(qos), user_data=message_type.user_data
        )
        self.graph.add(made)
        return made

    def _listen(self, reader: DataReader, take: Callable[[Sample], None]) -> None:
        self._takers[reader.guid] = take
        self.network.match_own(reader)  # not before: it may have samples already


def _ends_of(part: NodePart) -> tuple[DataWriter | DataReader, ...]:
    if isinstance(part, DdsCaller | DdsProvider):
        return part.ends.writer, part.ends.reader
    assert isinstance(part, DdsPublisher | DdsSubscription | DdsLifeWatch)
    return (part.end,)


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
    start: NodeStart,
    types: FileTypes,
    *,
    network: Sequence[str] = (),
    fragment_size: int = 63_000,
) -> AsyncGenerator[DdsNode, None]:
    """Open a node, and run it while the block is open; `network` and `fragment_size` are those of
    `DdsTransport`.

    Raises:
        TransportError: The sockets cannot be opened.
    """
    inbox = _Inbox()
    opened = open_network(domain, inbox.put, interfaces=network, fragment_size=fragment_size)
    async with opened as participant, Background() as tasks:
        node = DdsNode(participant, start, types, tasks)
        inbox.open(node.handle)
        yield node
