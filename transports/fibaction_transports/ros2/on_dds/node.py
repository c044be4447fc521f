"""A node of ROS over DDS, without ROS: its settings, a participant of RTPS, and the ends of its
topics.

What arrives is handed over on the event loop, in the order in which it has arrived.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any, ClassVar

from anyio.abc import TaskGroup

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.border.settings import check_range
from fibaction.words.errors import ProtocolError, TransportError
from fibaction_transports.ros2.node.mailbox import Drops
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    ErrorSink,
    MessageSink,
    NodePart,
    RequestSink,
    UnansweredSink,
)
from fibaction_transports.ros2.node.ros_node import RosAdapter
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
from fibaction_transports.ros2.settings import NodeSettings, OwnNodeSettings
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.own_node import NodeStart, OwnNode, node_start
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
from fibaction_transports.rtps.ports import IP_VERSIONS, DiscoveryRange, DomainSettings

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


DISCOVERY_SERVER = "ROS_DISCOVERY_SERVER"
"""The variable of Fast DDS for nodes that find each other by a server."""
_USUAL = "default"


class DdsSettings(OwnNodeSettings, frozen=True, kw_only=True):
    """The settings of a `DdsTransport`."""

    scheme = "dds"
    shared: ClassVar[tuple[str, ...]] = (
        *OwnNodeSettings.shared,
        "discovery",
        "peers",
        "ip_versions",
    )

    discovery: str = ""
    """`SUBNET`, `LOCALHOST` or `OFF`: how far other nodes are looked for. Without it,
    `ROS_AUTOMATIC_DISCOVERY_RANGE` says it, and else it is `SUBNET`, as in ROS."""
    peers: Sequence[str] = ()
    """Hosts that are asked in addition, where multicast does not reach; without them, those of
    `ROS_STATIC_PEERS`."""
    network: Sequence[str] = ()
    """The addresses of this machine's interfaces that take part in multicast; by default that of
    the default route."""
    ip_versions: Sequence[int] = ()
    """The versions of IP that are used: `(4,)`, `(6,)` or `(4, 6)`. By default 4, and 6 as well if
    a peer is an address of IPv6."""
    fragment_size: int = 63_000
    """Bytes of a message that go into one datagram, from 256 to 63,000. Where much is lost, a size
    below the MTU loses less."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        super().__post_init__()
        check_range("fragment_size", self.fragment_size, 256, 63_000)
        if self.discovery and self.discovery not in DiscoveryRange.__members__:
            known = ", ".join(DiscoveryRange.__members__)
            raise ValueError(f"discovery must be one of {known}, not {self.discovery!r}")
        if self.ip_versions and tuple(self.ip_versions) not in IP_VERSIONS:
            given = ",".join(map(str, self.ip_versions))
            raise ValueError(f"ip_versions must be one of 4, 6 and 4,6, not {given}")


class DdsAdapter(RosAdapter):
    """The way to a graph of ROS over our own DDS."""

    def __init__(self, node: NodeSettings, settings: DdsSettings) -> None:
        self.types = self._types = FileTypes(settings.search)
        self._node = node
        self._settings = settings

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[DdsNode, None]:
        """See `RosAdapter.open`."""
        opened = open_node(
            self.domain(),
            node_start(self._node),
            self._types,
            network=self._settings.network,
            fragment_size=self._settings.fragment_size,
        )
        async with opened as node:
            for sentence in self.left_out():
                node.warn(sentence)
            yield node

    def left_out(self) -> list[str]:
        """Return a sentence for each variable of the environment that is not followed here."""
        server = os.environ.get(DISCOVERY_SERVER)
        if not server:
            return []
        sentence = (
            f"{DISCOVERY_SERVER}={excerpt(server)} is not followed: dds:// does not speak to"
            " discovery servers, so nodes that are found only by one are not found here"
        )
        return [sentence]

    def origins(self) -> dict[str, str]:
        """Return where the domain, the range and the static peers come from: a setting, a variable
        of the environment, or the default.
        """
        settings = self._settings
        range_variable = "ROS_AUTOMATIC_DISCOVERY_RANGE"
        if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
            range_variable = "ROS_LOCALHOST_ONLY"
        return {
            name: f"setting {setting}"
            if is_set
            else variable
            if os.environ.get(variable)
            else _USUAL
            for name, setting, is_set, variable in (
                ("domain", "domain_id", self._node.domain_id is not None, "ROS_DOMAIN_ID"),
                ("range", "discovery", settings.discovery, range_variable),
                ("peers", "peers", settings.peers, "ROS_STATIC_PEERS"),
            )
        }

    def domain(self) -> DomainSettings:
        """Return the domain by the settings and the environment.

        Raises:
            TransportError: A variable of the environment has a value that ROS does not know.
        """
        settings, domain = self._settings, self._node.domain_id
        environ = dict(os.environ)
        if domain is not None:
            environ["ROS_DOMAIN_ID"] = str(domain)
        if settings.discovery:
            environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = settings.discovery
            environ.pop("ROS_LOCALHOST_ONLY", None)
        if settings.peers:
            environ["ROS_STATIC_PEERS"] = ";".join(settings.peers)
        try:
            return DomainSettings.from_environment(environ, tuple(settings.ip_versions))
        except ValueError as exc:
            raise TransportError(str(exc)) from exc
