"""The ends of topics over Zenoh."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh
from zenoh import ext

from fibaction_transports.ros2.node.mailbox import Drops, MessageNumbers
from fibaction_transports.ros2.node.parts import (
    LifeSigns,
    LifeWatch,
    MessageSink,
    TopicPublisher,
    TopicSubscription,
)
from fibaction_transports.ros2.on_zenoh.graph import ZenohGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    PUBLISHER,
    SUBSCRIPTION,
    OwnEnd,
    attachment,
    read_attachment,
)
from fibaction_transports.ros2.on_zenoh.session import ZenohSession
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType


class ZenohPublisher(TopicPublisher):
    """A publisher of a topic."""

    def __init__(
        self,
        session: ZenohSession,
        graph: ZenohGraph,
        end: OwnEnd,
        message_type: MessageType,
        qos: EndQos,
    ) -> None:
        self._sender = session.sender
        self._graph = graph
        self._gid = end.gid
        self._topic = end.name
        self._hash = end.type_hash
        self._encode = message_type.codec.encode
        self._number = 0
        self._sent = 0
        self._room = qos.room
        is_reliable = qos.reliability == "reliable"
        block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
        congestion = block if is_reliable else drop
        self.declared: Any  # a publisher, whose types are incomplete
        if qos.durability == "transient_local":
            # Without heartbeats, which tell that the last message was lost: none is lost, and a
            # publisher with heartbeats holds the garbage collector up for ten seconds now and then.
            self.declared = ext.declare_advanced_publisher(
                session.session,
                end.key,
                congestion_control=congestion,
                cache=ext.CacheConfig(max_samples=qos.depth),
                publisher_detection=True,
            )
        else:
            self.declared = session.session.declare_publisher(
                end.key, congestion_control=congestion
            )
        session.keep(self.declared)

    def publish(self, message: Any) -> None:
        self.publish_bytes(self._encode(message))

    def publish_bytes(self, message: bytes) -> None:
        if self._sender.held.has_room():
            self._number += 1
            self._sender.send(partial(self._write, message, self._number), len(message))

    def _write(self, message: bytes, number: int) -> None:
        self._sent = number
        self.declared.put(message, attachment=attachment(number, self._gid))

    def reader_count(self) -> int:
        return self._graph.count_connected(SUBSCRIPTION, self._topic, self._hash)

    def has_room(self) -> bool:
        return self._number - self._sent < self._room

    def has_arrived(self, margin: int) -> bool:
        # Zenoh waits until each message is in the queue of its link, which is short.
        return self._number - self._sent <= margin


class ZenohSubscription(TopicSubscription):
    """A subscription to a topic."""

    def __init__(
        self,
        session: ZenohSession,
        graph: ZenohGraph,
        end: OwnEnd,
        message_type: MessageType,
        qos: EndQos,
        take: MessageSink,
    ) -> None:
        self._graph = graph
        self._topic = end.name
        self._hash = end.type_hash
        self._take = take
        self.declared: Any  # a subscriber, whose types are incomplete
        self._unread = Drops(f"a message on {end.name}")
        self._must_be_whole = qos.reliability == "reliable" and qos.durability == "volatile"
        self._numbers = MessageNumbers(end.name)
        handler = session.sample_handler(self._receive)
        if qos.durability == "transient_local":
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)
            self.declared = ext.declare_advanced_subscriber(
                session.session,
                end.key,
                handler,
                history=history,
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            self.declared = session.session.declare_subscriber(end.key, handler)
        session.keep(self.declared)

    def _receive(self, sample: zenoh.Sample) -> None:
        words = sample.attachment
        read = None if words is None else read_attachment(words.to_bytes())
        if read is None:
            self._unread.note("it has no attachment of ROS")
            return
        if self._must_be_whole:
            self._numbers.note(read.gid, read.number)
        self._take(sample.payload.to_bytes(), self._graph.publisher(read.gid))

    def forget(self, publisher: bytes) -> None:
        """Forget a publisher that has gone, by its ID in messages."""
        self._numbers.forget(publisher)

    def tell_lost(self, take: Callable[[int], None]) -> None:
        self._numbers.tell(take)

    def publisher_count(self) -> int:
        return self._graph.count_connected(PUBLISHER, self._topic, self._hash)


class NoLifeWatch(LifeWatch):
    """A look-out that sees nothing: a server lives as long as its tokens are there."""

    def news(self) -> LifeSigns | None:
        return None
