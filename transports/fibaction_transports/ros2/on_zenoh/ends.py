"""The ends of services and topics over Zenoh.

A request is a query, which ends with its answer. A query ends without one, too, and that is told at
once: if no server has been found yet, if the server has thrown it away because its queue of ten was
full, and if the server has died. The caller sends the request again then, or learns that the server
has gone.

Released servers of `rmw_zenoh_cpp` forget to look at a request now and then, until something else
wakes them (https://github.com/ros2/rmw_zenoh/issues/1032): a nudge does, which is a request to
another service of the same node, without effect.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import anyio
import zenoh
from anyio import current_time
from zenoh import ext

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost, ProtocolError
from fibaction_transports.ros2.node.mailbox import Drops, MessageNumbers
from fibaction_transports.ros2.node.parts import (
    AnswerSink,
    ErrorSink,
    LifeSigns,
    LifeWatch,
    MessageSink,
    RequestSink,
    ServiceCaller,
    ServiceProvider,
    TopicPublisher,
    TopicSubscription,
    UnansweredSink,
)
from fibaction_transports.ros2.on_zenoh.config import QUERIES_TIMEOUT
from fibaction_transports.ros2.on_zenoh.graph import ZenohGraph
from fibaction_transports.ros2.on_zenoh.keys import (
    ANY_HASH,
    PUBLISHER,
    SERVER,
    SUBSCRIPTION,
    OwnEnd,
    attachment,
    read_attachment,
)
from fibaction_transports.ros2.on_zenoh.session import ZenohSession
from fibaction_transports.ros2.qos import EndQos
from fibaction_transports.ros2.without_ros.messages.message_type import MessageType, ServiceType

LONGEST: Final = 10.0**9
"""Seconds for which a request for a result waits: as long as its goal runs."""
OPEN_REQUESTS: Final = 10_000
"""Requests whose answers a client still knows; then the oldest is forgotten."""
FIRST_NUDGE: Final = 0.06
"""Seconds without an answer after which a server is nudged; each further nudge waits twice as long
as the one before."""
NUDGES: Final = 5
"""Nudges for one request."""
SHORT_QUEUE: Final = 10
"""The depth of the queues of rclpy and rclcpp: servers with longer ones need no nudge."""
_COMPLETE, _ALL = zenoh.QueryTarget.ALL_COMPLETE, zenoh.QueryTarget.ALL
"""The servers of a request: those of ROS; no server is complete for a key with any hash."""
_NOTHING: Final = bytes((0, 1, 0, 0, 0, 0, 0, 0))
"""A request about no parameters."""

logger = clean_logger("fibaction.ros2")


class Querier:
    """Sends requests in a session."""

    def __init__(self, session: ZenohSession) -> None:
        self._session = session

    def ask(
        self,
        key: str,
        payload: bytes,
        words: bytes,
        handler: zenoh.handlers.Callback[zenoh.Reply],
        seconds: float,
    ) -> None:
        """Send a request."""
        self._session.sender.send(
            partial(
                self._session.session.get,
                key,
                handler,
                target=_ALL if key.endswith(ANY_HASH) else _COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                timeout=seconds,
                payload=payload,
                attachment=words,
            ),
            len(payload),
        )


class _OpenRequest(NamedTuple):
    """A request that has no answer yet."""

    due: float
    """The time of the next nudge."""
    nudges: int


class ZenohCaller(ServiceCaller):
    """A client of a service."""

    def __init__(
        self,
        session: ZenohSession,
        graph: ZenohGraph,
        end: OwnEnd,
        service_type: ServiceType,
        take: AnswerSink,
        take_unreadable: ErrorSink | None,
        take_unanswered: UnansweredSink | None,
    ) -> None:
        self._session = session
        self._querier = Querier(session)
        self._graph = graph
        self._key = end.key
        self._gid = end.gid
        self._service = end.name
        self._hash = end.type_hash
        self._encode = service_type.Request.codec.encode
        self._decode = service_type.Response.codec.decode
        self._take = take
        self._take_unreadable = take_unreadable
        self._take_unanswered = take_unanswered
        self._drops = Drops(f"an answer of {end.name}")
        self._number = 0
        self._open: OrderedDict[int, _OpenRequest] = OrderedDict()
        self._sent = Notifier()
        self._is_closed = False
        self._timeout = LONGEST if end.name.endswith("/_action/get_result") else QUERIES_TIMEOUT

    def send(self, request: Any) -> int:
        if self._session.is_closed:
            raise ConnectionLost("the session of Zenoh is closed")
        self._number += 1
        number = self._number
        self._open[number] = _OpenRequest(current_time() + FIRST_NUDGE, 0)
        if len(self._open) > OPEN_REQUESTS:
            self._open.popitem(last=False)
        handler = self._session.reply_handler(
            partial(self._receive, number), partial(self._note_end, number)
        )
        words = attachment(number, self._gid)
        self._querier.ask(self._key, self._encode(request), words, handler, self._timeout)
        self._sent.notify()
        return number

    def forget(self, number: int) -> None:
        self._open.pop(number, None)

    def close(self) -> None:
        """Wait for no answer any more."""
        self._is_closed = True
        self._open.clear()
        self._sent.notify()

    def is_available(self) -> bool:
        return self._graph.count_connected(SERVER, self._service, self._hash) > 0

    def _receive(self, number: int, reply: zenoh.Reply) -> None:
        if number not in self._open:
            return  # another server has answered
        if reply.ok is None:
            logger.info("%s: a request failed at the server, or has timed out", self._service)
            return  # its end follows
        del self._open[number]
        try:
            response = self._decode(reply.ok.payload.to_bytes())
        except ProtocolError as exc:
            self._drops.note(exc)
            if self._take_unreadable is not None:
                self._take_unreadable(exc)
        else:
            self._take(number, response)

    def _note_end(self, number: int) -> None:
        if self._open.pop(number, None) is not None and self._take_unanswered is not None:
            self._take_unanswered(number)

    # Nudges

    async def run(self) -> None:
        """Nudge servers that do not look at their requests, until it is closed."""
        while not self._is_closed:
            due = min((one.due for one in self._open.values()), default=math.inf)
            if due == math.inf or not (servers := self._forgetful()):
                await self._sent.wait()
                continue
            await anyio.sleep_until(due)
            now = current_time()
            late = {number: one for number, one in self._open.items() if one.due <= now}
            for number, one in late.items():
                pause = FIRST_NUDGE * 2 ** (one.nudges + 1)
                due = now + pause if one.nudges + 1 < NUDGES else math.inf
                self._open[number] = _OpenRequest(due, one.nudges + 1)
            for key in servers if late else ():
                self._nudge(key)

    def _forgetful(self) -> list[str]:
        """Return the keys of services that wake the servers with short queues."""
        found: list[str] = []
        for server in self._graph.ends(SERVER, self._service):
            if server.qos.depth <= SHORT_QUEUE:
                wakers = self._graph.ends(SERVER, f"{server.node}/get_parameter_types")
                found += [one.key for one in wakers if one.session == server.session]
        return found

    def _nudge(self, key: str) -> None:
        self._number += 1
        handler = zenoh.handlers.Callback(ignore_reply, indirect=False)
        words = attachment(self._number, self._gid)
        self._querier.ask(key, _NOTHING, words, handler, QUERIES_TIMEOUT)


def ignore_reply(reply: zenoh.Reply) -> None:
    """Take an answer of which only the end counts."""


class QueryHeader(NamedTuple):
    """A query that waits for its answer."""

    query: zenoh.Query
    number: int
    client: bytes


class ZenohProvider(ServiceProvider):
    """A server of a service."""

    def __init__(
        self,
        session: ZenohSession,
        end: OwnEnd,
        service_type: ServiceType,
        take: RequestSink,
    ) -> None:
        self._session = session
        self._key = end.key
        self._decode = service_type.Request.codec.decode
        self._encode = service_type.Response.codec.encode
        self._take = take
        self._drops = Drops(f"a request to {end.name}")
        handler = session.query_handler(self._receive)
        self.declared = session.session.declare_queryable(end.key, handler, complete=True)
        session.keep(self.declared)

    def _receive(self, query: zenoh.Query) -> None:
        payload, words = query.payload, query.attachment
        read = None if words is None else read_attachment(words.to_bytes())
        if payload is None or read is None:
            return self._reject(query, "it does not name its client")
        try:
            request = self._decode(payload.to_bytes())
        except ProtocolError as exc:
            return self._reject(query, f"it cannot be read: {exc}")
        return self._take(QueryHeader(query, read.number, read.gid), request)

    def _reject(self, query: zenoh.Query, problem: str) -> None:
        self._drops.note(problem)
        self._session.sender.send(partial(_reply_error, query, problem), len(problem))

    def answer(self, header: QueryHeader, response: Any) -> bool:
        payload = self._encode(response)
        words = attachment(header.number, header.client)
        self._session.sender.send(
            partial(_reply, header.query, self._key, payload, words), len(payload)
        )
        return True


def _reply(query: zenoh.Query, key: str, payload: bytes, words: bytes) -> None:
    query.reply(key, payload, attachment=words)
    query.drop()


def _reply_error(query: zenoh.Query, problem: str) -> None:
    query.reply_err(problem)
    query.drop()


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
