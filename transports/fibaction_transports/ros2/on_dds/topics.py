"""The ends of topics over RTPS, and the names that ROS gives to topics and services in DDS.

https://design.ros2.org/articles/topic_and_service_names.html has the names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from anyio import current_time

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import LimitReached
from fibaction_transports.ros2.node.mailbox import MessageNumbers
from fibaction_transports.ros2.node.parts import (
    LifeSigns,
    LifeWatch,
    MessageSink,
    TopicPublisher,
    TopicSubscription,
)
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType
from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import LivelinessChanged
from fibaction_transports.rtps.messages.ids import OWN_VENDOR, Guid

GRAPH_TOPIC: Final = "ros_discovery_info"
"""The topic on which each participant tells which of its endpoints belong to which node."""
_TOPIC: Final = "rt"
_REQUESTS, _REPLIES = ("rq", "Request"), ("rr", "Reply")


def topic_name(full: str) -> str:
    """Return the name in DDS of a topic of ROS, which is given by its full name."""
    return _TOPIC + full


def request_topic(service: str) -> str:
    """Return the name in DDS of the topic with the requests to a service."""
    return service.join(_REQUESTS)


def reply_topic(service: str) -> str:
    """Return the name in DDS of the topic with the replies of a service."""
    return service.join(_REPLIES)


def ros_topic(name: str) -> str:
    """Return the full name in ROS of a topic of DDS; empty if it is not a topic of ROS."""
    return name.removeprefix(_TOPIC) if name.startswith(f"{_TOPIC}/") else ""


def ros_service(name: str) -> str:
    """Return the full name in ROS of a service by its topic of requests; empty if it is none."""
    first, last = _REQUESTS
    is_service = name.startswith(f"{first}/") and name.endswith(last)
    return name.removeprefix(first).removesuffix(last) if is_service else ""


logger = clean_logger("fibaction.ros2")


class DdsPublisher(TopicPublisher):
    """A publisher of a topic."""

    def __init__(
        self,
        writer: DataWriter,
        message_type: MessageType,
        write: Callable[..., object],
        room: float,
    ) -> None:
        """`write` is `ParticipantNetwork.write`, and `room` is `EndQos.room`."""
        self.end = writer
        self._room = room
        self._encode = message_type.codec.encode
        self._write = write

    def publish(self, message: Any) -> None:
        self.publish_bytes(self._encode(message))

    def publish_alone(self, message: Any) -> None:
        self.publish_bytes(self._encode(message), is_alone=True)

    def publish_bytes(self, message: bytes, *, is_alone: bool = False) -> None:
        try:
            self._write(self.end, message, is_alone=is_alone)
        except LimitReached as exc:
            logger.error("%s: a message is lost: %s", self.end.topic, exc)

    def reader_count(self) -> int:
        return len(self.end.matched)

    def has_room(self) -> bool:
        return self._room == math.inf or self.end.waiting(current_time()) < self._room

    def has_arrived(self, margin: int) -> bool:
        # Others acknowledge what waits in the queue of a reader, and may be pushed out of it.
        are_ours = all(reader.startswith(OWN_VENDOR) for reader in self.end.readers)
        return are_ours and self.end.has_arrived(margin)


class DdsSubscription(TopicSubscription):
    """A subscription to a topic."""

    can_pause = True

    def __init__(
        self,
        reader: DataReader,
        take: MessageSink,
        catch_up: Callable[[DataReader], bool],
        pause: Callable[[DataReader, bool], None],
    ) -> None:
        self.end = reader
        self._pause = pause
        self._take = take
        self._catch_up = catch_up
        self._waiting: list[Callable[[], None]] = []
        qos = reader.qos
        self._must_be_whole = qos.is_reliable and not qos.is_transient_local
        self._numbers = MessageNumbers(ros_topic(reader.topic))

    def receive(self, sample: Sample) -> None:
        """Take a message."""
        if self._must_be_whole:
            self._numbers.note(bytes(sample.writer), sample.number)
        self._take(sample.payload, bytes(sample.writer))

    def forget(self, writer: Guid) -> None:
        """Forget a publisher that has gone."""
        self._numbers.forget(bytes(writer))

    def pause(self, is_paused: bool, /) -> None:
        self._pause(self.end, is_paused)

    def tell_lost(self, take: Callable[[int], None]) -> None:
        self._numbers.tell(take)

    def publisher_count(self) -> int:
        # Without those that have not found the reader yet, and would lose the first messages.
        return len(self.end.confirmed_writers)

    def when_caught_up(self, then: Callable[[], None]) -> None:
        if self._catch_up(self.end):
            self._waiting.append(then)
        else:
            then()

    def note_caught_up(self) -> None:
        """Note that the reader has caught up, unless it has been asked again meanwhile."""
        if not self.end.is_catching_up:
            waiting, self._waiting = self._waiting, []
            for then in waiting:
                then()


class DdsLifeWatch(LifeWatch):
    """A look-out for signs of life, by the lease of liveliness of the publishers."""

    def __init__(self, reader: DataReader) -> None:
        self.end = reader
        self._silent: set[Guid] = set()
        self._told = LifeSigns(0, 0)

    def note(self, event: LivelinessChanged) -> None:
        """Note that a publisher has fallen silent, or is alive again."""
        if event.is_alive:
            self._silent.discard(event.writer)
        else:
            self._silent.add(event.writer)

    def news(self) -> LifeSigns | None:
        writers = set(self.end.writers)
        self._silent &= writers
        signs = LifeSigns(len(writers) - len(self._silent), len(self._silent))
        if signs == self._told:
            return None
        self._told = signs
        return signs
