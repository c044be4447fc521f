"""The graph of ROS, as discovery tells it: ends of topics, and the nodes that they belong to.

DDS knows participants and endpoints. Which of them belong to which node, each participant tells on
a topic of its own: https://design.ros2.org/articles/Node_to_Participant_mapping.html
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Container, Sequence
from contextlib import asynccontextmanager

from anyio import current_time

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ProtocolError, TransportError
from fibaction_transports.cdr.standard_messages import (
    GidMessage,
    NodeEntitiesInfo,
    ParticipantEntitiesInfo,
)
from fibaction_transports.ros2.node.parts import DiscoveryState, EndInfo
from fibaction_transports.ros2.node.ros_node import RosGraph
from fibaction_transports.ros2.on_dds.topics import (
    GRAPH_TOPIC,
    reply_topic,
    request_topic,
    ros_service,
    ros_topic,
    topic_name,
)
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.action_types import standard_type
from fibaction_transports.ros2.without_ros.messages.message_type import read_hashes, ros_type
from fibaction_transports.ros2.without_ros.ros_arguments import NodeName
from fibaction_transports.rtps.discovery.endpoint_discovery import EndpointData
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import Event, ParticipantLost, SampleReceived
from fibaction_transports.rtps.messages.ids import PREFIX_SIZE, READER_KINDS, WRITER_KINDS, Guid
from fibaction_transports.rtps.network import ParticipantNetwork, open_network
from fibaction_transports.rtps.ports import DomainSettings
from fibaction_transports.rtps.qos import Durability, Liveliness, Qos, Reliability

MOST_ENTITIES = 4_096
"""Endpoints that a participant may name as those of its nodes; a message with more is ignored."""
QUIET = 0.4
"""Seconds without news after which no participant is expected that does not begin just now.
Participants announce themselves when they begin, and answer the first announcements of others, of
which there is one in each 0.1 s, at once."""
ENDPOINTS_PATIENCE = 4.0
"""Seconds for which the endpoints of a new participant are waited for."""

_RELIABILITIES = {kind: kind.name.lower() for kind in Reliability}
_KINDS = {
    "automatic": Liveliness.AUTOMATIC,
    "manual_by_participant": Liveliness.BY_PARTICIPANT,
    "manual_by_topic": Liveliness.BY_TOPIC,
}
_WORDS = {kind: word for word, kind in _KINDS.items()}
_KEPT = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)

logger = clean_logger("fibaction.ros2")


def dds_qos(qos: EndQos) -> Qos:
    """Return the quality of service of an endpoint of RTPS."""
    return Qos(
        reliability=Reliability[qos.reliability.upper()],
        durability=Durability[qos.durability.upper()],
        depth=None if qos.history == "keep_all" else qos.depth,
        deadline=qos.deadline,
        lifespan=qos.lifespan,
        liveliness=_KINDS[qos.liveliness],
        liveliness_lease=qos.lease,
    )


def _end_qos(qos: Qos) -> EndQos:
    return EndQos(
        reliability=_RELIABILITIES[qos.reliability],
        durability="transient_local" if qos.durability else "volatile",
        history="keep_last" if qos.depth else "keep_all",
        depth=qos.depth or 0,
        deadline=qos.deadline,
        liveliness=_WORDS[qos.liveliness],
        lease=qos.liveliness_lease,
        lifespan=qos.lifespan,
    )


class DdsGraph(RosGraph):
    """The ends of all topics, those of this node among them."""

    def __init__(self, network: ParticipantNetwork, node: NodeName) -> None:
        """Announce a node without ends, and listen for the nodes of others."""
        self._participant = network.participant
        self._network = network
        self._node = node
        self._own: dict[Guid, DataWriter | DataReader] = {}
        self._nodes: dict[bytes, dict[bytes, str]] = {}
        """The nodes of the endpoints of each other participant."""
        info = standard_type("ParticipantEntitiesInfo")
        self._codec = info.codec
        names = GRAPH_TOPIC, info.dds_name, _KEPT
        self._writer = network.create_writer(*names, user_data=info.user_data)
        self.reader = network.create_reader(*names, user_data=info.user_data)
        """The reader of the nodes of others."""
        self._changed = Notifier()
        self._is_announced = False

    # This node

    def add(self, end: DataWriter | DataReader) -> None:
        """Add an end of this node."""
        self._own[end.guid] = end
        self._announce_later()

    def remove(self, end: DataWriter | DataReader) -> None:
        """Remove an end of this node."""
        del self._own[end.guid]
        self._announce_later()

    def _announce_later(self) -> None:
        self._is_announced = False
        self._changed.notify()

    async def run(self) -> None:
        """Announce the ends of this node when they have changed, until canceled. Ends that are made
        together are announced once.
        """
        while True:
            while self._is_announced:
                await self._changed.wait()
            self._is_announced = True
            self._network.write(self._writer, self._codec.encode(self._announcement()))

    def _announcement(self) -> ParticipantEntitiesInfo:
        ends = self._own.values()
        node = NodeEntitiesInfo(
            self._node.namespace,
            self._node.name,
            [GidMessage(end.guid) for end in ends if isinstance(end, DataReader)],
            [GidMessage(end.guid) for end in ends if isinstance(end, DataWriter)],
        )
        return ParticipantEntitiesInfo(GidMessage(self._participant.guid), [node])

    # Other nodes

    def receive(self, sample: Sample) -> None:
        """Take the nodes of another participant."""
        prefix = sample.writer.prefix
        try:
            info = self._codec.decode(sample.payload)
        except ProtocolError as exc:
            logger.info("the nodes of participant %s cannot be read: %s", prefix.hex(), exc)
            return
        found = {
            gid.data: str(NodeName(node.node_name, node.node_namespace))
            for node in info.node_entities_info_seq
            for gid in (*node.reader_gid_seq, *node.writer_gid_seq)
        }
        if len(found) <= MOST_ENTITIES:
            self._nodes[prefix] = found

    def forget(self, prefix: bytes) -> None:
        """Forget the nodes of a participant that is gone."""
        self._nodes.pop(prefix, None)

    # Questions

    def discovery(self) -> DiscoveryState:
        """See `GraphView.discovery`. A participant is pending until its endpoints have come, as far
        as its heartbeats tell of them, and its nodes.
        """
        peers = self._participant
        known = len(peers.remote_participants) + peers.count_remote_endpoints()
        pending = peers.incomplete_participants(current_time() - ENDPOINTS_PATIENCE, self.reader)
        return DiscoveryState(known + len(self._nodes), pending, QUIET)

    def nodes(self) -> set[str]:
        return {name for found in self._nodes.values() for name in found.values()}

    def nodes_of(self, prefix: bytes) -> list[str]:
        """Return the full names of the nodes of another participant that have endpoints."""
        return sorted(set(self._nodes.get(prefix, {}).values()))

    def topics(self) -> list[tuple[str, str]]:
        found = {
            ros_topic(end.topic): ros_type(end.type_name)
            for end in (*self._own.values(), *self._participant.remote_endpoints)
            if ros_topic(end.topic)
        }
        return list(found.items())

    def services(self) -> list[tuple[str, str]]:
        found = {
            ros_service(end.topic): ros_type(end.type_name).removesuffix("_Request")
            for end in (*self._own.values(), *self._participant.remote_endpoints)
            if end.guid.is_reader and ros_service(end.topic)
        }
        return list(found.items())

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return self.writers(topic_name(topic))

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return self.readers(topic_name(topic))

    def writers(self, topic: str) -> Sequence[EndInfo]:
        """Return the writers of a topic of DDS."""
        return [self._info(end) for end in self._ends(topic) if end.guid[-1] in WRITER_KINDS]

    def readers(self, topic: str) -> Sequence[EndInfo]:
        """Return the readers of a topic of DDS."""
        return [self._info(end) for end in self._ends(topic) if end.guid[-1] in READER_KINDS]

    def request_readers(self, service: str) -> Sequence[EndInfo]:
        return self.readers(request_topic(service))

    def answer_writers(self, service: str) -> Sequence[EndInfo]:
        return self.writers(reply_topic(service))

    # Without a look at what the ends have to tell.

    def count_callers(self, service: str) -> int:
        return self._count(request_topic(service), WRITER_KINDS)

    def count_publishers(self, topic: str) -> int:
        return self._count(topic_name(topic), WRITER_KINDS)

    def count_subscriptions(self, topic: str) -> int:
        return self._count(topic_name(topic), READER_KINDS)

    def _count(self, topic: str, kinds: Container[int]) -> int:
        return len([end for end in self._ends(topic) if end.guid[-1] in kinds])

    def _ends(self, topic: str) -> list[EndpointData | DataWriter | DataReader]:
        own = [end for end in self._own.values() if end.topic == topic]
        return [*own, *self._participant.remote_endpoints_on(topic)]

    def _info(self, end: EndpointData | DataWriter | DataReader) -> EndInfo:
        if end.guid in self._own:
            node = str(self._node)
        else:
            node = self._nodes.get(end.guid[:PREFIX_SIZE], {}).get(bytes(end.guid), "")
        data, type_id = b"", b""
        if isinstance(end, EndpointData):
            data, type_id = end.user_data, end.type_id
        hashes, type_name = read_hashes(data), ros_type(end.type_name)
        return EndInfo(bytes(end.guid), node, _end_qos(end.qos), *hashes, type_id, type_name)


_NO_NODE = NodeName("", "/")


@asynccontextmanager
async def open_scout(domain: int) -> AsyncGenerator[DdsGraph, None]:
    """Look at the graph of a domain, with the other settings of ROS in the environment: a scout for
    a node of another middleware.

    rclpy tells what it knows of the graph, and not what it knows to be missing: Fast DDS takes one
    or two seconds to find ten nodes, with pauses longer than one. Our RTPS knows of each
    participant whether all of its endpoints have come, and mostly has them after 0.2 s. A scout has
    no node, so others see nothing of it in the graph.

    Raises:
        TransportError: The sockets cannot be opened, or a variable of the environment has a value
            that ROS does not know.
    """
    found: list[DdsGraph] = []

    def handle(event: Event) -> None:
        for graph in found:
            if isinstance(event, ParticipantLost):
                graph.forget(event.prefix)
            elif isinstance(event, SampleReceived):
                graph.receive(event.sample)

    try:
        settings = DomainSettings.from_environment({**os.environ, "ROS_DOMAIN_ID": str(domain)})
    except ValueError as exc:
        raise TransportError(str(exc)) from exc
    async with open_network(settings, handle) as network:
        found.append(DdsGraph(network, _NO_NODE))
        yield found[0]
