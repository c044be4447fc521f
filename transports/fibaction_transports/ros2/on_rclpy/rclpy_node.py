"""A node of rclpy, which makes and destroys everything in ROS that this package uses.

rclpy needs an order: a handle is made before a thread waits for it, and is destroyed after no
thread waits for it any more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, suppress
from functools import partial
from typing import Any, cast

from fibaction.border.peer_text import MESSAGE, clean_logger, excerpt
from fibaction.words.errors import ConnectionLost, TransportError
from fibaction_transports.ros2.node.mailbox import Mailbox, Sink
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    DiscoveryState,
    EndInfo,
    ErrorSink,
    GraphView,
    MessageSink,
    NodePart,
    RequestSink,
    ScoutOpener,
    ServiceCaller,
    ServiceProvider,
    UnansweredSink,
    no_scout,
    scouted_view,
)
from fibaction_transports.ros2.node.ros_node import RosClock, RosNode
from fibaction_transports.ros2.on_rclpy.ends import (
    RclpyCaller,
    RclpyEnd,
    RclpyLifeWatch,
    RclpyProvider,
    RclpyPublisher,
    RclpySubscription,
    end_info,
    profile_of,
)
from fibaction_transports.ros2.on_rclpy.rcl import (
    LIVELINESS_CHANGED,
    Duration,
    IntrospectionState,
    InvalidHandle,
    JumpThreshold,
    UnsupportedEventType,
    check_for_type_support,
    middleware,
    raw,
    rclpy_qos,
)
from fibaction_transports.ros2.on_rclpy.rclpy_parameters import RclpyParameters
from fibaction_transports.ros2.on_rclpy.rclpy_types import RclpyTypes
from fibaction_transports.ros2.on_rclpy.spinner import (
    Messages,
    Requests,
    Responses,
    RosWaitable,
    Source,
)
from fibaction_transports.ros2.qos import EndQos


class NodeClock(RosClock):
    """The clock of a node, and the number of times that it has begun again."""

    def __init__(self, node: Any) -> None:
        self._clock = node.get_clock()
        self.era = 0
        self._jumps = self._clock.create_jump_callback(
            JumpThreshold(
                min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
            ),
            post_callback=self._begin_anew,
        )

    def _begin_anew(self, jump: Any) -> None:
        # In the thread that rclpy spins. No other thread writes it.
        self.era += 1

    @property
    def is_the_machines(self) -> bool:
        return self.era == 0 and not self._clock.ros_time_is_active

    def now(self) -> int:
        nanoseconds: int = self._clock.now().nanoseconds
        return nanoseconds

    def close(self) -> None:
        """Note no more jumps."""
        with suppress(InvalidHandle):  # the user has destroyed the node
            self._jumps.unregister()


SURE = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp", "rmw_cyclonedds_cpp", "rmw_connextdds")
"""Middlewares that tell of each sign of life. rmw_zenoh_cpp had no such event, and since
https://github.com/ros2/rmw_zenoh/pull/934 it has one that does not occur."""

UNSCOUTED_QUIET = 1.5
"""Seconds without news after which no node is expected, if there is no scout: Fast DDS has longer
pauses than one second while it finds ten nodes."""

logger = clean_logger("fibaction.ros2")


class RclpyNode(RosNode):
    """A node of rclpy with a `RosWaitable`, for as long as a block lasts."""

    confirms_callers = False

    def __init__(self, node: Any, scout: ScoutOpener = no_scout) -> None:
        super().__init__()
        self.node = node
        self._scout = scout
        self.types = RclpyTypes()
        self.clock = self._clock = NodeClock(node)
        self.full_name: str = node.get_fully_qualified_name()
        self.namespace: str = node.get_namespace()
        self.tells_signs = middleware() in SURE
        self.matches_by_qos = middleware() != "rmw_zenoh_cpp"
        self._logger = node.get_logger()
        self._mailbox = Mailbox(self.wake)
        self.parameters = RclpyParameters(
            node, lambda call, changed: self._mailbox.put([(call, changed)])
        )
        self.sources = RosWaitable(self._mailbox)
        """The sources of fibaction at this node."""
        self._handles: list[Any] = []

    @property
    def is_up(self) -> bool:
        """See `RosNode.is_up`. It is polled, because ROS does not announce that a signal has shut
        it down, or that the user has destroyed the node.
        """
        if self.error is None:
            if not self.node.context.ok():
                self.lose("rclpy was shut down")
            elif not self._has_node():
                self.lose("the node was destroyed")
        return self.error is None

    def _has_node(self) -> bool:
        try:
            with self.node.handle:
                return True
        except InvalidHandle:
            return False

    def attempt(self, call: Callable[..., Any], *arguments: Any, otherwise: Any = None) -> Any:
        """Call rclpy, and return the result; `otherwise` if ROS was shut down, which may happen at
        any moment.
        """
        try:
            return call(*arguments)
        except Exception:
            if self.is_up:
                raise
            return otherwise

    def resolve(self, name: str) -> str:
        try:
            full: str = self.node.resolve_topic_name(name)
        except Exception as exc:  # rclpy raises whatever rcl says
            reason = " ".join(str(exc).split()).partition(", at ")[0]  # then a line of C
            raise TransportError(f"{excerpt(name)!r} is not a valid name in ROS: {reason}") from exc
        return full

    def warn(self, text: str) -> None:
        if self._can_log(text):
            self._logger.warning(excerpt(text, MESSAGE))

    def complain(self, text: str) -> None:
        if self._can_log(text):
            # Not in one place with `warn`: rclpy allows one severity for each line of code.
            self._logger.error(excerpt(text, MESSAGE))

    def _can_log(self, text: str) -> bool:
        if not self.is_up:
            logger.info("%s", text)
        return self.is_up

    # Parts

    def publisher(self, topic: str, message_type: Any, qos: EndQos) -> RclpyPublisher:
        handle = self._make(raw.Publisher, message_type, topic, qos)
        return RclpyPublisher(handle, self.attempt, qos)

    def subscription(
        self,
        topic: str,
        message_type: Any,
        qos: EndQos,
        take: MessageSink,
        *,
        is_first: bool = False,
    ) -> RclpySubscription:
        handle = self._make(raw.Subscription, message_type, topic, qos)
        source = Messages(handle, message_type, _each(take))
        self.listen(source, first=is_first)
        return RclpySubscription(handle, self.attempt, partial(self._pause, source))

    def caller(
        self,
        service: str,
        service_type: Any,
        qos: EndQos,
        take: AnswerSink,
        take_unreadable: ErrorSink | None = None,
        take_unanswered: UnansweredSink | None = None,
    ) -> RclpyCaller:
        handle = self._make(raw.Client, service_type, service, qos)
        self.listen(Responses(handle, service_type, _each(take), take_unreadable))
        return RclpyCaller(handle, self.attempt)

    def provider(
        self, service: str, service_type: Any, qos: EndQos, take: RequestSink
    ) -> RclpyProvider:
        handle = self._make(raw.Service, service_type, service, qos)
        self.listen(Requests(handle, service_type, _each(take)))
        return RclpyProvider(handle, self.attempt)

    def life_watch(self, topic: str, message_type: Any, qos: EndQos) -> RclpyLifeWatch:
        subscription = self._make(raw.Subscription, message_type, topic, qos)
        event: Any = None
        with subscription, suppress(UnsupportedEventType):
            event = self.keep(raw.EventHandle(subscription, LIVELINESS_CHANGED))
        return RclpyLifeWatch(subscription, event, self.attempt)

    def remove(self, part: NodePart) -> None:
        assert isinstance(part, RclpyEnd | RclpyLifeWatch)
        self.sources.remove(part.handle)
        if part.handle in self._handles:  # else ROS was shut down
            self._handles.remove(part.handle)
            part.handle.destroy_when_not_in_use()
        self.wake()

    def _make(self, kind: Any, ros_type: Any, name: str, qos: EndQos) -> Any:
        """Make a raw handle, which is destroyed at the end.

        Raises:
            TransportError: ROS does not allow it.
        """
        try:
            check_for_type_support(ros_type)
            profile = profile_of(qos).get_c_qos_profile()
            with self.node.handle:
                handle = kind(self.node.handle, ros_type, name, profile)
        except Exception as exc:  # rclpy raises whatever rcl says
            raise TransportError(f"{name}: {exc}") from exc
        return self.keep(handle)

    def keep(self, handle: Any) -> Any:
        """Destroy this raw handle at the end. Returns it."""
        self._handles.append(handle)
        return handle

    def introspect(self, level: str, *services: ServiceCaller | ServiceProvider) -> None:
        if level == "off":
            return
        state = IntrospectionState.__members__[level.upper()]
        profile = rclpy_qos.qos_profile_system_default.get_c_qos_profile()
        clock = self.node.get_clock().handle
        for service in services:
            handle = cast("RclpyCaller | RclpyProvider", service).handle
            handle.configure_introspection(clock, profile, state)

    def _pause(self, source: Source, is_paused: bool) -> None:
        source.is_paused = is_paused
        self.wake()

    def listen(self, *sources: Source, first: bool = False) -> None:
        """Take what arrives at these sources: see `RosWaitable.add`."""
        self.sources.add(*sources, first=first)
        self.wake()

    # The graph

    def observed(self) -> AbstractAsyncContextManager[GraphView]:
        open_scout = self._scout if middleware() in SURE else no_scout
        domain = self.attempt(self.node.context.get_domain_id, otherwise=0)
        return scouted_view(self, self.full_name, domain, open_scout)

    def discovery(self) -> DiscoveryState:
        return DiscoveryState(len(self.topics()) + len(self.nodes()), 0, UNSCOUTED_QUIET)

    def nodes(self) -> set[str]:
        found = self.attempt(self.node.get_node_names_and_namespaces, otherwise=())
        return {f"{namespace.rstrip('/')}/{name}" for name, namespace in found}

    def topics(self) -> list[tuple[str, str]]:
        found = self.attempt(self.node.get_topic_names_and_types, otherwise=())
        return [(topic, types[0]) for topic, types in found]

    def services(self) -> list[tuple[str, str]]:
        found = self.attempt(self.node.get_service_names_and_types, otherwise=())
        return [(service, types[0]) for service, types in found]

    def publishers(self, topic: str) -> list[EndInfo]:
        return self._ends(self.node.get_publishers_info_by_topic, topic)

    def subscriptions(self, topic: str) -> list[EndInfo]:
        return self._ends(self.node.get_subscriptions_info_by_topic, topic)

    def count_publishers(self, topic: str) -> int:
        return self._count(self.node.count_publishers, topic)

    def count_subscriptions(self, topic: str) -> int:
        return self._count(self.node.count_subscribers, topic)

    def count_callers(self, service: str) -> int:
        return self._count(self.node.count_clients, service)

    def _count(self, look: Callable[[str], int], name: str) -> int:
        count: int = self.attempt(look, name, otherwise=0)
        return count

    # ROS tells the quality of service of topics. That of services it tells only as DDS has them, as
    # two topics each, so with other middlewares nothing is said of services.

    def request_readers(self, service: str) -> list[EndInfo]:
        look = self.node.get_subscriptions_info_by_topic
        return self._ends(look, f"rq{service}Request", True)

    def answer_writers(self, service: str) -> list[EndInfo]:
        return self._ends(self.node.get_publishers_info_by_topic, f"rr{service}Reply", True)

    def _ends(self, look: Callable[..., Any], *arguments: Any) -> list[EndInfo]:
        return [end_info(one) for one in self.attempt(look, *arguments, otherwise=())]

    # Its end

    def wake(self) -> None:
        """Make the executor collect again what it waits for."""
        executor = self.node.executor
        if executor is not None:
            executor.wake()

    def lose(self, reason: str) -> None:
        """Note that nothing more will arrive, and leave the graph."""
        if self.error is None:
            logger.info("nothing more arrives over ROS: %s", reason)
            self.fail(ConnectionLost(reason))
            self._destroy()

    def lose_later(self, reason: str) -> None:
        """Call `lose` on the event loop, from any thread."""
        self._mailbox.put([(self.lose, reason)])

    async def run(self) -> None:
        """Handle what arrives, until canceled."""
        await self._mailbox.run()

    def start(self) -> None:
        """Let the executor of a user's node take what arrives."""
        self.node.add_waitable(self.sources)

    def close(self) -> None:
        """Destroy all handles; those that an executor waits for are destroyed when it wakes."""
        with suppress(ValueError):
            self.node.remove_waitable(self.sources)
        self._clock.close()
        self._destroy()
        self._mailbox.close()

    def _destroy(self) -> None:
        self.sources.clear()
        for handle in reversed(self._handles):
            handle.destroy_when_not_in_use()
        self._handles.clear()
        self.wake()


def _each(take: Callable[[Any, Any], None]) -> Sink:
    """Return the sink for the pairs that a source takes."""
    return lambda pair: take(*pair)
