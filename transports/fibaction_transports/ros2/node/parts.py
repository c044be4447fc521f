"""The parts of a node: the ends of topics and services, and what the graph says of others.

An adapter of a middleware implements these classes beside `RosNode`. None of their methods waits,
and none raises because ROS has been shut down, unless it says so: a call has no effect then, and
nothing is found.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

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
