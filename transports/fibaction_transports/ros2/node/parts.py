"""The parts of a node, which are the ends of topics and services, and its view of the graph.

An adapter of a middleware implements these classes beside `RosNode`. None of their methods waits,
and none raises because ROS has been shut down, unless it says so: a call has no effect then, and
nothing is found.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager, suppress
from typing import Any, Final, NamedTuple, TypeAlias

import anyio

from fibaction.words.errors import TransportError
from fibaction_transports.ros2.qos import EndQos

MessageSink: TypeAlias = Callable[[bytes, bytes], None]
"""Takes a serialized message, and the ID (GID) of its publisher, which is empty if not known."""
RequestSink: TypeAlias = Callable[[Any, Any], None]
"""Takes the header of a request, and the request."""
AnswerSink: TypeAlias = Callable[[int, Any], None]
"""Takes the number of a request, and the answer to it."""
ErrorSink: TypeAlias = Callable[[Exception], None]
"""Takes the reason why something that has arrived cannot be read."""
UnansweredSink: TypeAlias = Callable[[int], None]
"""Takes the number of a request that will have no answer."""


NO_HASH: Final = "TypeHashNotSupported"
"""The hash of each type, as nodes of ROS 2 Humble tell it in Zenoh."""


class EndInfo(NamedTuple):
    """A publisher or a subscription of any node, as the graph describes it."""

    gid: bytes
    """Its ID. An end that is made again has another one."""
    node: str
    """The full name of its node, for example `/robot/arm`; empty if it is not known yet."""
    qos: EndQos
    type_hash: str = ""
    """The hash of the type of its messages, if the middleware tells it; `NO_HASH` in Humble."""
    action_hash: str = ""
    """That of the action whose feedback it publishes, if it is one of fibaction over DDS."""
    type_id: bytes = b""
    """The ID of that type in XTypes, over DDS, if its participant tells it."""
    type_name: str = ""
    """The name of the type of its messages in ROS, as `std_msgs/msg/String`."""


class LifeSigns(NamedTuple):
    """The number of servers that have given a sign of life in time, and of those that have not."""

    alive: int
    not_alive: int


class TopicPublisher(ABC):
    """A publisher of a topic."""

    @abstractmethod
    def publish(self, message: Any) -> None:
        """Publish a message."""

    def publish_alone(self, message: Any) -> None:
        """Publish a message that belongs to no others, and so does not wait for them."""
        self.publish(message)

    @abstractmethod
    def publish_bytes(self, message: bytes) -> None:
        """Publish a serialized message."""

    @abstractmethod
    def reader_count(self) -> int:
        """Return the number of subscriptions that are connected."""

    @abstractmethod
    def has_room(self) -> bool:
        """Return whether a publisher that keeps all messages can take another one: as many as its
        depth may wait for reliable readers. Others always can.
        """

    def has_arrived(self, margin: int) -> bool:
        """Return whether all messages but the newest ones, up to the margin, are known to have been
        taken by all readers. By default that is not known.
        """
        return False


class TopicSubscription(ABC):
    """A subscription to a topic."""

    @abstractmethod
    def publisher_count(self) -> int:
        """Return the number of publishers that are connected."""

    can_pause: bool = False
    """True if `pause` has an effect."""

    def pause(self, is_paused: bool, /) -> None:  # noqa: B027  # the middleware may not have it
        """Leave messages with their publishers, which may then wait, or take them again."""

    def tell_lost(  # noqa: B027  # rclpy does not tell
        self, take: Callable[[int], None]
    ) -> None:
        """Call `take` with the number of messages that are lost, before the one that shows it. By
        default, the middleware does not tell.
        """

    def when_caught_up(self, then: Callable[[], None]) -> None:
        """Call `then` when all messages have been taken that were published before now, as far as
        the middleware can find out; at once if it cannot, as by default, or if it need not ask.
        """
        then()


class ServiceCaller(ABC):
    """A client of a service."""

    @abstractmethod
    def send(self, request: Any) -> int:
        """Send a request, and return its number.

        Raises:
            ConnectionLost: Nothing can be sent any more.
        """

    @abstractmethod
    def is_available(self) -> bool:
        """Return whether a server of the service is connected."""

    @abstractmethod
    def forget(self, number: int) -> None:
        """Wait no more for the answer to a request, which may have come."""


class ServiceProvider(ABC):
    """A server of a service."""

    @abstractmethod
    def answer(self, header: Any, response: Any) -> bool:
        """Answer a request; return False if the answer cannot reach its client yet."""


class LifeWatch(ABC):
    """A look-out for signs of life of the publishers of a topic."""

    @abstractmethod
    def news(self) -> LifeSigns | None:
        """Return how many are alive; None if that has not changed since the last call."""


NodePart: TypeAlias = (
    TopicPublisher | TopicSubscription | ServiceCaller | ServiceProvider | LifeWatch
)
"""A part of a node that can be removed."""


FEEDBACK = "/_action/feedback"
"""The end of the name of an action's feedback topic, after the name of the action."""
_FEEDBACK_MESSAGE = "_FeedbackMessage"


class DiscoveryState(NamedTuple):
    """The state of discovery, as far as a middleware tells."""

    known: int
    """The participants, nodes and ends that are known: another number is news."""
    pending: int
    """Participants that are known, and whose ends or nodes have not all come."""
    quiet: float
    """Seconds without news after which nothing more is expected."""


class GraphView(ABC):
    """A view of a graph: its topics, their ends, and the nodes."""

    @abstractmethod
    def discovery(self) -> DiscoveryState:
        """Return the state of discovery."""

    @abstractmethod
    def nodes(self) -> set[str]:
        """Return the full names of the nodes that are known."""

    @abstractmethod
    def topics(self) -> list[tuple[str, str]]:
        """Return the topics, with or without a publisher, each with the name of its type."""

    @abstractmethod
    def services(self) -> list[tuple[str, str]]:
        """Return the services that are served, each with the name of its type."""

    @abstractmethod
    def publishers(self, topic: str) -> Sequence[EndInfo]:
        """Return the publishers of a topic, connected or not."""

    @abstractmethod
    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        """Return the subscriptions to a topic, connected or not."""

    # Counts may be quicker than lists.

    def count_publishers(self, topic: str) -> int:
        """Return the number of publishers of a topic, connected or not."""
        return len(self.publishers(topic))

    def count_subscriptions(self, topic: str) -> int:
        """Return the number of subscriptions to a topic, connected or not."""
        return len(self.subscriptions(topic))

    def served_actions(self) -> list[tuple[str, str]]:
        """Return the feedback topics of all actions with a server, each with the action's type."""
        return sorted(
            (topic, type_name.removesuffix(_FEEDBACK_MESSAGE))
            for topic, type_name in self.topics()
            if topic.endswith(FEEDBACK)
            and type_name.endswith(_FEEDBACK_MESSAGE)
            and self.count_publishers(topic)
        )


class JoinedViews(GraphView):
    """Two views of the same graph: what either of them knows."""

    def __init__(self, one: GraphView, other: GraphView) -> None:
        """Join two views, of which the second one tells the state of discovery."""
        self._one = one
        self._other = other

    def discovery(self) -> DiscoveryState:
        return self._other.discovery()

    def nodes(self) -> set[str]:
        return self._one.nodes() | self._other.nodes()

    def topics(self) -> list[tuple[str, str]]:
        return sorted({*self._one.topics(), *self._other.topics()})

    def services(self) -> list[tuple[str, str]]:
        return sorted({*self._one.services(), *self._other.services()})

    def publishers(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.publishers(topic), self._other.publishers(topic))

    def subscriptions(self, topic: str) -> Sequence[EndInfo]:
        return _joined(self._one.subscriptions(topic), self._other.subscriptions(topic))


def _joined(one: Sequence[EndInfo], other: Sequence[EndInfo]) -> list[EndInfo]:
    """Return the ends of both, each once, with its node if either knows it."""
    found = {end.gid: end for end in other}
    found.update((end.gid, end) for end in one if end.node or end.gid not in found)
    return list(found.values())


SCOUT_PATIENCE = 1.0
"""Seconds within which a scout finds the node."""
SCOUT_PAUSE = 0.01

ScoutOpener: TypeAlias = Callable[[int], AbstractAsyncContextManager[GraphView]]
"""Opens a view of the graph of a domain; raises `TransportError` if it cannot."""


def no_scout(domain: int) -> AbstractAsyncContextManager[GraphView]:
    """Open no view.

    Raises:
        TransportError: Always.
    """
    raise TransportError(f"nothing looks at the domain {domain}")


@asynccontextmanager
async def scouted_view(
    own: GraphView, node: str, domain: int, open_scout: ScoutOpener
) -> AsyncGenerator[GraphView, None]:
    """Look at a graph with the view of a node, by its full name, and that of a scout next to the
    node, which tells how far discovery has come.

    A scout counts only if it sees the node, too: another middleware or security may hide the graph
    from it. Then the node's own view is all there is.
    """
    async with AsyncExitStack() as stack:
        view = own
        with suppress(TransportError):
            scout = await stack.enter_async_context(open_scout(domain))
            with anyio.move_on_after(SCOUT_PATIENCE):
                await _find(node, scout)
                view = JoinedViews(own, scout)
        yield view


async def _find(node: str, scout: GraphView) -> None:
    while node not in scout.nodes():  # noqa: ASYNC110  # nothing tells of a new node
        await anyio.sleep(SCOUT_PAUSE)
