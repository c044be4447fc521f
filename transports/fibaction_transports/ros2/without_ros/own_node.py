"""A node without ROS, whatever the middleware: its name, its clock, its parameters, its log, and
what it tells of its types.

A node is asked for a type by its hash, as endpoints announce it. Like nodes of rclpy, it describes
its topics' messages, its services and its actions as a whole.
"""

from __future__ import annotations

import logging
import re
import struct
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

from fibaction.border.peer_text import MESSAGE, clean_logger, excerpt
from fibaction.interfaces.files import InterfaceMessage
from fibaction.words.errors import TransportError
from fibaction_transports.cdr.type_hashes import PREFIX, Description, type_description, type_hash
from fibaction_transports.ros2.node.own_parameters import DeclaredParameter
from fibaction_transports.ros2.node.parts import (
    DiscoveryState,
    EndInfo,
    ServiceCaller,
    ServiceProvider,
)
from fibaction_transports.ros2.node.ros_node import RosClock, RosGraph, RosNode
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.descriptions import described_types
from fibaction_transports.ros2.without_ros.descriptions.described_types import GET_TYPE_DESCRIPTION
from fibaction_transports.ros2.without_ros.descriptions.type_learner import (
    ActionQuestions,
    TypeLearner,
)
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    CLOCK,
    LOG,
    ROSOUT,
    ROSOUT_QOS,
    RosoutLog,
)
from fibaction_transports.ros2.without_ros.parameters import USE_SIM_TIME, NodeParameters
from fibaction_transports.ros2.without_ros.ros_arguments import (
    NameResolver,
    NodeName,
    Override,
    node_name,
    overrides_of,
    read_arguments,
)

NOT_USED: Final = "Type not currently in use by this node"
NOT_A_HASH: Final = "Failed to parse type hash"
"""The words of rclpy."""
_HASH = re.compile(rf"{PREFIX}[0-9a-f]{{64}}")
_ACTION_PARTS = ("goal", "result", "feedback")
_IMPLICIT, _ACTION, _MESSAGE = "implicit", "action", "msg"


class TypeRegistry:
    """The types that a node uses, by their hashes."""

    def __init__(self) -> None:
        self._new: list[InterfaceMessage] = []
        """The types whose hashes are not yet needed."""
        self._seen: set[str] = set()
        self._by_hash: dict[str, InterfaceMessage] = {}

    def add_messages(self, message_type: MessageType) -> None:
        """Add the type of an endpoint, and its action if it has one."""
        if message_type.is_known:
            self._add(message_type.definition)
        if message_type.action is not None:
            self._add(message_type.action)
            for part in ("send_goal_service", "get_result_service"):
                self._add(message_type.action.nested[part])

    def add_service(self, service_type: ServiceType) -> None:
        """Add the type of a service."""
        if service_type.is_known:
            self._add(service_type.definition)

    def _add(self, definition: InterfaceMessage) -> None:
        if definition.type_name not in self._seen:
            self._seen.add(definition.type_name)
            self._new.append(definition)

    def answer(
        self, request: described_types.DescriptionRequest
    ) -> described_types.DescriptionResponse:
        """Describe a type."""
        if not _HASH.fullmatch(request.type_hash):
            return described_types.DescriptionResponse(failure_reason=NOT_A_HASH)
        self._by_hash |= {type_hash(one): one for one in self._new}
        self._new.clear()
        found = self._by_hash.get(request.type_hash)
        if found is None:
            return described_types.DescriptionResponse(failure_reason=NOT_USED)
        sources = list(_sources(found)) if request.include_type_sources else []
        return described_types.DescriptionResponse(
            successful=True, type_description=_described(found), type_sources=sources
        )


def _described(definition: InterfaceMessage) -> described_types.TypeDescription:
    whole = type_description(definition)
    return described_types.TypeDescription(
        _individual(whole["type_description"]),
        [_individual(one) for one in whole["referenced_type_descriptions"]],
    )


def _individual(description: Description) -> described_types.IndividualTypeDescription:
    fields = [
        described_types.FieldDescription(
            field["name"],
            described_types.FieldTypeDescription(**field["type"]),
        )
        for field in description["fields"]
    ]
    return described_types.IndividualTypeDescription(description["type_name"], fields)


def _sources(definition: InterfaceMessage) -> Iterator[described_types.TypeSource]:
    """Yield the texts of a type, and of all that it nests."""
    seen: set[str] = set()
    left = [definition]
    while left:
        one = left.pop()
        if one.type_name in seen:
            continue
        seen.add(one.type_name)
        left.extend(one.nested.values())
        yield described_types.TypeSource(one.type_name, *_source_text(one))


def _source_text(definition: InterfaceMessage) -> tuple[str, str]:
    """Return the encoding of a text, and the text. What ROS makes of files by itself has none."""
    folder = definition.type_name.split("/")[1]
    if folder == _ACTION and set(_ACTION_PARTS) <= definition.nested.keys():
        parts = (definition.nested[part].definition.text for part in _ACTION_PARTS)
        return _ACTION, "---\n".join(parts)
    if folder == _MESSAGE and definition.definition.text:
        return _MESSAGE, definition.definition.text
    return _IMPLICIT, ""


CLOCK_TOPIC: Final = "/clock"
_BILLION = 10**9
_TIME = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}
_START = 4


class OwnClock(RosClock):
    """The clock of a node."""

    def __init__(self) -> None:
        self.era = 0
        self._is_simulated = False
        self._now = 0

    @property
    def is_the_machines(self) -> bool:
        return self.era == 0 and not self._is_simulated

    def now(self) -> int:
        return self._now if self._is_simulated else time.time_ns()

    def use_simulated(self, wanted: bool) -> None:
        """Use the time of a simulation, or that of the machine."""
        if wanted != self._is_simulated:
            self._is_simulated = wanted
            self.era += 1

    def take(self, message: bytes, publisher: bytes) -> None:
        """Take a `rosgraph_msgs/msg/Clock`; it is ignored if it is not one."""
        form = _TIME.get(message[1]) if len(message) >= _START + 8 else None
        if form is None:
            return
        seconds, nanoseconds = form.unpack_from(message, _START)
        now = seconds * _BILLION + nanoseconds
        if now < self._now:
            self.era += 1
        self._now = now


class NodeStart(NamedTuple):
    """The name, the names and the log with which a node begins."""

    name: NodeName
    resolver: NameResolver
    has_rosout: bool
    """True if its log goes to the topic `/rosout`, too."""
    overrides: dict[str, Override]
    """The values of parameters in the arguments."""


def node_start(settings: NodeSettings) -> NodeStart:
    """Return what the settings and the arguments say.

    Raises:
        TransportError: ROS does not allow the name, or an argument is not valid.
    """
    given = settings.arguments
    arguments = read_arguments(sys.argv if given is None else given)
    name = settings.name or f"fibaction_{uuid.uuid4().hex[:8]}"
    full = node_name(name, settings.namespace, arguments)
    resolver = NameResolver(full, arguments)
    overrides = overrides_of(str(full), arguments.parameters)
    return NodeStart(full, resolver, arguments.has_rosout, overrides)


_NEWEST = EndQos(reliability="best_effort", depth=1)
_SERVICES = EndQos(depth=1000)

logger = clean_logger("fibaction.ros2")


class OwnNode(RosNode):
    """A node that this project makes."""

    scheme: ClassVar[str]
    """The scheme of the URLs of its transport."""

    def __init__(
        self,
        graph: RosGraph,
        start: NodeStart,
        types: FileTypes,
        questions: ActionQuestions,
    ) -> None:
        """Serve what every node serves. What a subclass needs for its parts is there before."""
        super().__init__()
        self.types = types
        self.clock = self._clock = OwnClock()
        self.full_name = str(start.name)
        self.namespace = start.name.namespace
        self.in_use = TypeRegistry()
        """The types of the parts, which others may ask for."""
        self._graph = graph
        self._resolver = start.resolver
        self._learner = TypeLearner(self, types, questions)
        self._hears_time = False
        self.parameters = NodeParameters(self, start.overrides)
        self.parameters.serve(self.provide)
        self._rosout: RosoutLog | None = None
        if start.has_rosout:
            log = self.publisher(self.resolve(ROSOUT), LOG, ROSOUT_QOS)
            self._rosout = RosoutLog(self.full_name, log.publish)
        description = f"{self.full_name}/get_type_description"
        self.provide(description, GET_TYPE_DESCRIPTION, self.in_use.answer)
        self.parameters.on_change(self._use_simulated_time)
        try:
            self.parameters.declare(DeclaredParameter(name=USE_SIM_TIME, default=False))
        except ValueError as exc:
            raise TransportError(str(exc)) from exc
        self._use_simulated_time({USE_SIM_TIME: self.parameters.value(USE_SIM_TIME)})

    def provide(
        self, service: str, service_type: ServiceType, answer: Callable[[Any], Any]
    ) -> None:
        """Serve a service whose answers need no time.

        Raises:
            TransportError: The service cannot be made.
        """

        def take(header: Any, request: Any) -> None:
            if not provider.answer(header, answer(request)):
                logger.info("%s: an answer cannot reach its client, and is lost", service)

        provider = self.provider(service, service_type, _SERVICES, take)

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

    def _use_simulated_time(self, changed: Mapping[str, Any]) -> None:
        wanted = changed.get(USE_SIM_TIME)
        if wanted is not None:
            self._clock.use_simulated(wanted)
        if wanted and not self._hears_time:
            self._hears_time = True
            self.subscription(CLOCK_TOPIC, CLOCK, _NEWEST, self._clock.take)

    def introspect(self, level: str, *services: ServiceCaller | ServiceProvider) -> None:
        if level != "off":
            raise TransportError(
                f"introspection={level!r} needs ROS itself: leave it out with {self.scheme}://"
            )

    # The graph

    async def learn(self, actions: Sequence[tuple[str, str]]) -> None:
        await self._learner.learn(actions)

    async def learn_topic(self, topic: str, type_name: str) -> None:
        await self._learner.learn_topic(topic, type_name)

    def discovery(self) -> DiscoveryState:
        return self._graph.discovery()

    def nodes(self) -> set[str]:
        return self._graph.nodes()

    def topics(self) -> list[tuple[str, str]]:
        return self._graph.topics()

    def services(self) -> list[tuple[str, str]]:
        return self._graph.services()

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return self._graph.publishers(topic)

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return self._graph.subscriptions(topic)

    def request_readers(self, service: str) -> Sequence[EndInfo]:
        return self._graph.request_readers(service)

    def answer_writers(self, service: str) -> Sequence[EndInfo]:
        return self._graph.answer_writers(service)

    def count_callers(self, service: str) -> int:
        return self._graph.count_callers(service)

    def count_publishers(self, topic: str) -> int:
        return self._graph.count_publishers(topic)

    def count_subscriptions(self, topic: str) -> int:
        return self._graph.count_subscriptions(topic)
