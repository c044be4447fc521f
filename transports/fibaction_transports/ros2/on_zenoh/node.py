"""A node of ROS over Zenoh, without ROS: its settings, its session, and its topics and services."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import ClassVar, Final, Literal, TypeVar

import anyio
import zenoh
from anyio import to_thread
from anyio.abc import TaskGroup

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError, text_of
from fibaction_transports.ros2.node.parts import (
    NO_HASH,
    AnswerSink,
    EndInfo,
    ErrorSink,
    MessageSink,
    NodePart,
    RequestSink,
    UnansweredSink,
)
from fibaction_transports.ros2.node.ros_node import Links, RosAdapter, RosNode
from fibaction_transports.ros2.on_zenoh.config import Configuration
from fibaction_transports.ros2.on_zenoh.ends import (
    NoLifeWatch,
    ZenohCaller,
    ZenohProvider,
    ZenohPublisher,
    ZenohSubscription,
    ignore_reply,
)
from fibaction_transports.ros2.on_zenoh.graph import ZenohGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    CLIENT,
    PUBLISHER,
    SERVER,
    SUBSCRIPTION,
    NodeTokens,
    OwnEnd,
    all_tokens,
    hash_of,
    key_of,
)
from fibaction_transports.ros2.on_zenoh.session import ZenohSession, open_session
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.settings import NodeSettings, OwnNodeSettings, domain_in
from fibaction_transports.ros2.without_ros.descriptions.described_types import (
    DescriptionRequest,
    IndividualTypeDescription,
    UnusableDescription,
)
from fibaction_transports.ros2.without_ros.descriptions.type_learner import (
    ActionQuestions,
    ask_node,
)
from fibaction_transports.ros2.without_ros.messages.file_types import FileTypes
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType
from fibaction_transports.ros2.without_ros.own_node import NodeStart, OwnNode, node_start

_PARTS = ("_SendGoal", "_GetResult", "_FeedbackMessage")


class ServiceQuestions(ActionQuestions):
    """The questions about both services of an action, and about its feedback.

    Tokens announce the hashes of services, of which rclpy tells all types: so goals and results.
    """

    def __init__(self, node: RosNode) -> None:
        self._node = node

    def can_ask(self, ends: Sequence[EndInfo]) -> bool:
        return all(one.type_hash for one in ends)

    async def look_up(
        self, ends: Sequence[EndInfo], type_name: str
    ) -> dict[str, IndividualTypeDescription]:
        found: dict[str, IndividualTypeDescription] = {}
        for part, end in zip(_PARTS, ends, strict=True):
            request = DescriptionRequest(type_name + part, end.type_hash)
            response = await ask_node(self._node, end.node, request)
            if not response.successful:
                raise UnusableDescription(response.failure_reason)
            whole = response.type_description
            described = (whole.type_description, *whole.referenced_type_descriptions)
            found |= {one.type_name: one for one in described}
        return found


NO_ROUTER = (
    "no router and no peer of Zenoh is connected (tried {}): `ros2 run rmw_zenoh_cpp rmw_zenohd`"
    " starts a router, or, without ROS, `fibaction router`"
)
NO_NODES = (
    "the router has heard of no other node of this domain: nodes that were started before it was"
    " restarted may have to be started again; is"
)
LAST_WORDS: Final = 0.05
"""Seconds for the answers of a server that has gone."""
ROUTER_PAUSE: Final = 1.0
"""Seconds until a router is looked for again."""

EndT = TypeVar("EndT", bound=NodePart)

logger = clean_logger("fibaction.ros2")


class ZenohNode(OwnNode):
    """A node over Zenoh."""

    tells_signs = False
    matches_by_qos = False
    scheme = "zenoh"

    def __init__(
        self,
        session: ZenohSession,
        domain: int,
        start: NodeStart,
        types: FileTypes,
        tasks: TaskGroup,
        has_hashes: bool,
    ) -> None:
        self.session = session
        self._has_hashes = has_hashes
        self._domain = domain
        self._tasks = tasks
        self.graph = ZenohGraph(has_hashes)
        self._tokens = NodeTokens(
            domain, session.zid, session.numbers, start.name.namespace, start.name.name
        )
        self._parts: dict[NodePart, zenoh.LivelinessToken] = {}
        """The parts, each with the token that announces it."""
        self._no_router = NO_ROUTER.format(session.locators)
        self._links: dict[str, None] = {}
        self._had_link = False
        self._hear_links()
        self._hear_tokens()
        self._announce(self._tokens.node())
        questions = ServiceQuestions(self)
        super().__init__(self.graph, start, types, questions)

    def _hear_tokens(self) -> None:
        session, everything = self.session, all_tokens(self._domain)
        liveliness = session.session.liveliness()

        def changed(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.PUT:
                self.graph.add(token)
            elif (gone := self.graph.remove(token)) is not None and gone.kind == PUBLISHER:
                for part in self._parts:
                    if isinstance(part, ZenohSubscription):
                        part.forget(gone.wire_gid)

        session.keep(
            liveliness.declare_subscriber(everything, session.sample_handler(changed), history=True)
        )

        # The subscription does not say when it has told all that was there; a query after it does.
        handler = session.reply_handler(ignore_reply, self.graph.note_complete)
        liveliness.get(everything, handler)

    def _hear_links(self) -> None:
        links = self._links

        def changed(event: zenoh.TransportEvent) -> None:
            other = str(event.transport.zid)
            if event.kind == zenoh.SampleKind.PUT:
                links[other], self._had_link = None, True
            else:
                links.pop(other, None)
            self.graph.news.notify()

        handler = self.session.handler(changed)
        info = self.session.session.info
        self.session.keep(info.declare_transport_events_listener(handler, history=True))

    @property
    def is_cut(self) -> bool:
        return self._had_link and not self._links

    async def last_words(self) -> None:
        """See `RosNode.last_words`. Zenoh closes the link, removes the tokens of all that was
        behind it, and then tells that the link was lost, one after another.
        """
        await anyio.sleep(LAST_WORDS)
        known, info = list(self._links), self.session.session.info
        linked = {str(one.zid) for one in await to_thread.run_sync(info.links)}
        for other in known:
            if other not in linked:
                self._links.pop(other, None)

    async def graph_news(self, seconds: float) -> None:
        with anyio.move_on_after(seconds):
            await self.graph.news.wait()

    async def find_router(self, attempts: float) -> None:
        """Look so many times for a router or a peer; the log tells each time that there is none."""
        while not self._links and attempts > 0:
            attempts -= 1
            with anyio.move_on_after(ROUTER_PAUSE):
                while not self._links:
                    await self.graph.news.wait()
            if not self._links:
                self.told.add(self._no_router)
                logger.warning(self._no_router)

    def _announce(self, token: str) -> zenoh.LivelinessToken:
        declared = self.session.session.liveliness().declare_token(token)
        self.session.keep(declared)
        self.graph.add(token)
        return declared

    # Parts

    def publisher(self, topic: str, message_type: MessageType, qos: EndQos) -> ZenohPublisher:
        end = self._end(PUBLISHER, topic, message_type, qos)
        self.in_use.add_messages(message_type)
        return self._declared(
            end, lambda: ZenohPublisher(self.session, self.graph, end, message_type, qos)
        )

    def subscription(
        self,
        topic: str,
        message_type: MessageType,
        qos: EndQos,
        take: MessageSink,
        *,
        is_first: bool = False,
    ) -> ZenohSubscription:
        end = self._end(SUBSCRIPTION, topic, message_type, qos)
        self.in_use.add_messages(message_type)
        return self._declared(
            end, lambda: ZenohSubscription(self.session, self.graph, end, message_type, qos, take)
        )

    def caller(
        self,
        service: str,
        service_type: ServiceType,
        qos: EndQos,
        take: AnswerSink,
        take_unreadable: ErrorSink | None = None,
        take_unanswered: UnansweredSink | None = None,
    ) -> ZenohCaller:
        end = self._end(CLIENT, service, service_type, qos)
        self.in_use.add_service(service_type)
        caller = ZenohCaller(
            self.session,
            self.graph,
            end,
            service_type,
            take,
            take_unreadable,
            take_unanswered,
        )
        self._parts[caller] = self._announce(end.token)
        self._tasks.start_soon(caller.run, name=f"client of {service}")
        return caller

    def provider(
        self, service: str, service_type: ServiceType, qos: EndQos, take: RequestSink
    ) -> ZenohProvider:
        end = self._end(SERVER, service, service_type, qos)
        self.in_use.add_service(service_type)
        return self._declared(end, lambda: ZenohProvider(self.session, end, service_type, take))

    def life_watch(self, topic: str, message_type: MessageType, qos: EndQos) -> NoLifeWatch:
        return NoLifeWatch()

    def remove(self, part: NodePart) -> None:
        token = self._parts.pop(part, None)
        if token is None:
            return  # it is no part of Zenoh, as a `NoLifeWatch`
        self.session.remove(token)
        if isinstance(part, ZenohCaller):
            part.close()
        else:
            assert isinstance(part, ZenohPublisher | ZenohSubscription | ZenohProvider)
            self.session.remove(part.declared)

    async def links(self) -> Links:
        """See `RosNode.links`."""
        info = self.session.session.info
        routers, peers = await to_thread.run_sync(lambda: (info.routers_zid(), info.peers_zid()))
        facts = {
            "domain": self._domain,
            "session": self.session.zid,
            "zenoh_routers": [str(one) for one in routers],
            "zenoh_peers": [str(one) for one in peers],
        }
        if not (routers or peers):
            return Links(facts, self._no_router)
        if self.graph.nodes() <= {self.full_name}:
            return Links(facts, f"{NO_NODES} ROS_DOMAIN_ID {self._domain} there, too?")
        return Links(facts, "")

    def _end(self, kind: str, name: str, of: MessageType | ServiceType, qos: EndQos) -> OwnEnd:
        """Return a new end."""
        type_hash = hash_of(of) if self._has_hashes else NO_HASH
        key = key_of(self._domain, name, of.name, type_hash)
        token = self._tokens.end(kind, name, of.name, type_hash, qos)
        return OwnEnd(name, key, token, type_hash)

    def _declared(self, end: OwnEnd, make: Callable[[], EndT]) -> EndT:
        """Make an end, and announce it: others use it as soon as they see its token."""
        try:
            made = make()
            self._parts[made] = self._announce(end.token)
        except zenoh.ZError as exc:
            raise TransportError(f"Zenoh does not allow it: {text_of(exc)}") from exc
        return made


@asynccontextmanager
async def open_node(
    configuration: Configuration,
    domain: int,
    start: NodeStart,
    types: FileTypes,
    has_hashes: bool = True,
) -> AsyncGenerator[ZenohNode, None]:
    """Open a node, and run it while the block is open; without hashes, it is one of Humble.

    Raises:
        TransportError: The session cannot be opened.
    """
    async with open_session(configuration) as session, Background() as tasks:
        node = ZenohNode(session, domain, start, types, tasks, has_hashes)
        if (attempts := configuration.attempts) is None:
            tasks.start_soon(node.find_router, 1.0, name="look for a router")
        else:
            await node.find_router(attempts)
        yield node


class ZenohSettings(OwnNodeSettings, frozen=True, kw_only=True):
    """The settings of a `ZenohTransport`."""

    scheme = "zenoh"
    shared: ClassVar[tuple[str, ...]] = (*OwnNodeSettings.shared, "locators", "type_hashes")

    locators: Sequence[str] = ()
    """The routers or peers to connect to, for example `tcp/robot.local:7447`. Without them, those
    of the configuration of ROS, or `tcp/localhost:7447`."""
    mode: Literal["", "peer", "client"] = ""
    """`peer` connects to the nodes that it learns of from a router, and continues when the router
    stops; `client` speaks through the router only, and needs less memory. Without it, that of the
    configuration of ROS, or `peer`."""
    config: str = ""
    """Values of Zenoh's own configuration, which count before all others, as `key=json5;key=json5`:
    for example `transport/auth/usrpwd/user="me";transport/auth/usrpwd/password="secret"`."""

    type_hashes: bool = True
    """False for the nodes of ROS 2 Humble, which do not tell the versions of types."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A number is out of range, or a word is not one of those that are valid.
        """
        super().__post_init__()
        if self.mode not in ("", "peer", "client"):
            raise ValueError(f"mode is peer or client, not {self.mode!r}")


class ZenohAdapter(RosAdapter):
    """The way to a graph of ROS over Zenoh."""

    def __init__(self, node: NodeSettings, settings: ZenohSettings) -> None:
        self.types = self._types = FileTypes(settings.search)
        self._node = node
        self._settings = settings

    @asynccontextmanager
    async def open(self) -> AsyncGenerator[ZenohNode, None]:
        """See `RosAdapter.open`."""
        start, settings = node_start(self._node), self._settings
        configuration = Configuration(
            mode=settings.mode,
            locators=settings.locators,
            environ=os.environ,
            lease=settings.lease,
            values=settings.config,
        )
        given = self._node.domain_id
        domain = domain_in(os.environ) if given is None else given
        hashes = settings.type_hashes
        async with open_node(configuration, domain, start, self._types, hashes) as node:
            yield node
