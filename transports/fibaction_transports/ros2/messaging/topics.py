"""Publishers of topics, and subscriptions: async iterators with a bounded queue, and those that the
calls of a node for single messages share.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf
from time import perf_counter
from typing import Any, Final, Generic, Self, TypeAlias, TypeVar

import anyio
from anyio.abc import TaskGroup
from msgspec.structs import replace

from fibaction.border.abc import Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.border.streams import Closing
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2 import qos
from fibaction_transports.ros2.messaging.forms import MessageForm
from fibaction_transports.ros2.node.mailbox import MAILBOX, Drops
from fibaction_transports.ros2.node.parts import TopicSubscription
from fibaction_transports.ros2.node.ros_node import RosNode, TopicType
from fibaction_transports.ros2.qos import EndQos

TURN: Final = 0.001
"""Seconds after which a loop that publishes lets other tasks have their turn."""

T = TypeVar("T")


class Publisher(Closing, Generic[T]):
    """A publisher of a topic. Messages leave in the order in which they are published."""

    def __init__(
        self, ros: RosNode, topic: str, topic_type: TopicType, form: MessageForm, end_qos: EndQos
    ) -> None:
        """Announce it; `Node.publisher` does it."""
        self.topic = topic
        """The full name of the topic."""
        self._ros = ros
        self._form = form
        self._qos = end_qos
        self._part = ros.publisher(topic, topic_type.message, end_qos)
        self._is_closed = False
        self._yielded = -inf
        """The time at which others had their turn here."""

    async def publish(self, message: T | dict[str, Any], *, timeout: float | None = None) -> None:
        """Publish a message, or a dict with its fields; those that it leaves out have the defaults
        of ROS.

        It does not wait for readers, which may miss messages if they are slow, unless the
        publisher was made with `qos="keep_all"`: then it waits while reliable readers have not
        taken the last `depth` messages. A reader that takes none for ten seconds is given up.

        Raises:
            ValueError: It does not fit the type; the text names the field.
            TimeoutError: Readers have not taken enough in the seconds of the timeout.
            ConnectionLost: The node can send nothing any more.
            anyio.ClosedResourceError: The publisher was closed.
        """
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._ros.raise_if_lost()
        made = self.message(message)
        if not self._part.has_room():
            await self._until(self._part.has_room, timeout, "readers have taken too little of")
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._part.publish_alone(made)
        # Not after each message: a turn costs as much as ten of them. The time between them counts,
        # since the loop may work that long without any turn of others.
        if perf_counter() - self._yielded > TURN:
            await anyio.lowlevel.checkpoint()
            self._yielded = perf_counter()

    def message(self, value: T | dict[str, Any]) -> Any:
        """Return a value as the message that is published.

        Raises:
            ValueError: It does not fit the type; the text names the field.
        """
        try:
            return self._form.to_ros(value)
        except ValueError as exc:
            raise ValueError(f"{self.topic}: {exc}") from exc

    def reader_count(self) -> int:
        """Return the number of subscriptions that are connected."""
        return self._part.reader_count()

    async def wait_for_reader(self, timeout: float | None = None, *, count: int = 1) -> None:
        """Wait until so many subscriptions are connected; for ever without a timeout in seconds.

        Raises:
            TimeoutError: There were fewer in time; the text says whose QoS does not match.
            ConnectionLost: The node can send nothing any more.
        """
        what = "nobody has" if count == 1 else f"fewer than {count} have"
        await self._until(
            lambda: self._part.reader_count() >= count, timeout, f"{what} subscribed to"
        )

    async def _until(self, look: Callable[[], object], timeout: float | None, problem: str) -> None:
        with anyio.move_on_after(timeout):
            await self._ros.until(look)
            return
        raise TimeoutError(f"{problem} {self.topic} in {timeout:g} s{self._mismatch()}")

    def _mismatch(self) -> str:
        """Return what keeps readers away: another type, or the first difference of QoS, as both
        sides have it.
        """
        ends = self._ros.subscriptions(self.topic)
        if others := self._form.other_types(ends):
            return f": its subscriptions have the type {others}"
        for end in ends if self._ros.matches_by_qos else ():
            if told := qos.difference(self._qos, end.qos):
                offers, wants = told
                return f": this publisher offers {offers}, and {end.node or 'a node'} wants {wants}"
        return ""

    def close(self) -> None:
        """Remove the publisher from the graph. Closing twice does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._ros.remove(self._part)


SILENCE: Final = 5.0
"""Seconds without a first message after which the log tells what does not match, if something does
not."""
LATE: Final = 2 * MAILBOX
"""Messages that are taken although their publishers are to wait: they were on their way, through
the mailbox of rclpy. A publisher of the same node that keeps the last ones does not wait."""

logger = clean_logger("fibaction.ros2")


class Subscription(Closing, Generic[T]):
    """The messages of a topic, in the order in which they arrive.

    It is an async iterator, which ends when it is closed, and raises `ConnectionLost` when its node
    is. A reader that is slower than the topic gets the newest messages; those that it has missed
    are counted, unless the depth is 1: then the newest one is wanted. With `qos="keep_all"`,
    publishers that keep all wait for it instead, over `dds://` and `ros2://`. If several tasks read
    one subscription, each message goes to one of them.
    """

    def __init__(
        self, ros: RosNode, topic: str, topic_type: TopicType, form: MessageForm, qos: EndQos
    ) -> None:
        """Subscribe; `Node.subscribe` does it."""
        self.topic = topic
        """The full name of the topic."""
        self._ros = ros
        self._type = topic_type.message
        self._form = form
        self._qos = qos
        self._queue: deque[bytes] = deque(maxlen=qos.depth)
        self._drops = Drops(f"a message on {topic}")
        self._is_paused = False
        self._newest: bytes | None = None
        self._news = Notifier()
        self._is_closed = False
        self._is_explained = False
        self._part: TopicSubscription = ros.subscription(topic, self._type, qos, self._take)
        self._room = qos.room if self._part.can_pause else inf
        if self._room < inf:
            self._queue = deque(self._queue, maxlen=qos.depth + LATE)
        self._forget = ros.on_loss(lambda error: self._news.notify())

    @property
    def dropped(self) -> int:
        """Messages that no one has read before newer ones took their places, or could read."""
        return self._drops.count

    def _take(self, message: bytes, publisher: bytes) -> None:
        if len(self._queue) == self._queue.maxlen != 1:  # of 1, the newest is wanted
            self._drops.note("newer ones came before it was read")
        self._queue.append(message)
        if len(self._queue) >= self._room and not self._is_paused:
            self._pause(True)
        self._newest = message
        self._news.notify()

    def _pause(self, is_paused: bool) -> None:
        self._is_paused = is_paused
        self._part.pause(is_paused)

    @property
    def latest(self) -> T | None:
        """The newest message that has arrived, whether it has been read or not; None before the
        first one, and if it is none of the type.
        """
        return None if self._newest is None else self._read(self._newest)

    def publisher_count(self) -> int:
        """Return the number of publishers that are connected."""
        return self._part.publisher_count()

    async def next(self, timeout: float | None = None) -> T:
        """Wait for the next message that has not been read; for ever without a timeout in seconds.

        Raises:
            TimeoutError: There was none in time; the text says what may be wrong.
            ConnectionLost: The node can receive nothing any more.
            anyio.ClosedResourceError: The subscription was closed.
        """
        with anyio.move_on_after(timeout):
            return await self._next()
        raise self._missed(timeout)

    async def upcoming(self, timeout: float | None = None) -> T:
        """Wait for a message that arrives from now on, whatever others read; at once, if the topic
        keeps messages for late readers, for the newest one. The errors are those of `next`.
        """
        with anyio.move_on_after(timeout):
            is_kept = self._qos.durability == "transient_local"
            before = None if is_kept else self._newest
            while True:
                if self._newest is not before and (value := self.latest) is not None:
                    return value
                self._raise_if_over()
                await self._wait()
        raise self._missed(timeout)

    def _missed(self, timeout: float | None) -> TimeoutError:
        reason = self._explanation() or f"connected publishers: {self._part.publisher_count()}"
        return TimeoutError(f"nothing arrived on {self.topic} in {timeout:g} s: {reason}")

    async def _next(self) -> T:
        while True:
            if self._is_paused and len(self._queue) <= self._room // 2:
                self._pause(False)
            if self._queue:
                if (value := self._read(self._queue.popleft())) is not None:
                    return value
                continue
            self._raise_if_over()
            await self._wait()

    def _raise_if_over(self) -> None:
        if self._is_closed:
            raise anyio.ClosedResourceError
        self._ros.raise_if_lost()

    async def _wait(self) -> None:
        if self._newest is None and not self._is_explained:
            with anyio.move_on_after(SILENCE):
                return await self._news.wait()
            self._is_explained = True
            reason = self._explanation()
            if reason:
                self._ros.warn(f"nothing arrives on {self.topic}: {reason}")
        return await self._news.wait()

    def _read(self, message: bytes) -> T | None:
        """Return a message; None if it cannot be read."""
        try:
            value: T = self._form.from_ros(self._ros.types.decode(message, self._type))
        except ProtocolError as exc:
            self._drops.note(f"it cannot be read: {excerpt(str(exc))}")
            if self._newest is message:
                self._newest = None
            if self._queue and self._queue[-1] is message:
                self._queue.pop()
            return None
        return value

    def _explanation(self) -> str:
        """Return what keeps messages away; empty if nothing is known to."""
        ends = self._ros.publishers(self.topic)
        if not ends:
            return "no node publishes it"
        if others := self._form.other_types(ends):
            return f"its publishers have the type {others}"
        for end in ends if self._ros.matches_by_qos else ():
            if told := qos.difference(end.qos, self._qos):
                offers, wants = told
                return (
                    f"{end.node or 'a node'} offers {offers}, and this subscription wants {wants}:"
                    f" subscribe with {qos.advice(end.qos, self._qos)}"
                )
        version = self._ros.types.version(self._type)
        theirs = {end.type_hash for end in ends}
        if version is not None and "" not in theirs and version.type_hash not in theirs:
            return f"its publishers have another version of {version.type_name}"
        if "transient_local" in {end.qos.durability for end in ends} - {self._qos.durability}:
            return "what was published before is read with qos='transient_local'"
        return ""

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> T:
        try:
            return await self._next()
        except anyio.ClosedResourceError:
            raise StopAsyncIteration from None

    def close(self) -> None:
        """End the subscription. Closing twice does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self._queue.clear()
            self._forget()
            self._ros.remove(self._part)
            self._news.notify()


KEPT_OPEN: Final = 5.0
"""Seconds for which a subscription stays open for the next call of `Node.next`."""
MOST_SHARED: Final = 1_000
"""Subscriptions that are open; then that gives way which was not used for the longest time."""

Wanted: TypeAlias = tuple[str, str | type[Any], EndQos]
"""A topic by its full name, its type, and a quality of service."""


class _Shared:
    """An open subscription, and who uses it."""

    def __init__(self, subscription: Subscription[Any]) -> None:
        self.subscription = subscription
        self.is_followed = False
        """True if the newest message was asked for, which may be asked for again at any time."""
        self.waiting = 0
        self.used = 0.0
        """The time at which the last call ended."""


def _closing_time(shared: _Shared) -> float:
    return inf if shared.is_followed or shared.waiting else shared.used + KEPT_OPEN


class NewestMessages:
    """The newest messages of topics, each read by one subscription for all calls."""

    def __init__(self, subscribe: Callable[..., Subscription[Any]], tasks: TaskGroup) -> None:
        """`subscribe` is `Node.subscribe`, and `tasks` are those of the node."""
        self._subscribe = subscribe
        self._tasks = tasks
        self._shared: dict[Wanted, _Shared] = {}
        """The one that was used last is at the end."""
        self._news = Notifier()
        self._has_closer = False

    def latest(self, wanted: Wanted) -> Any | None:
        """Return the newest message; None if none has arrived yet."""
        shared = self._open(wanted)
        shared.is_followed = True
        return shared.subscription.latest

    async def next(self, wanted: Wanted, timeout: float | None) -> Any:
        """Wait for a message that arrives from now on; see `Subscription.upcoming`."""
        shared = self._open(wanted)
        shared.waiting += 1
        try:
            return await shared.subscription.upcoming(timeout)
        finally:
            shared.waiting -= 1
            shared.used = anyio.current_time()
            self._news.notify()

    def _open(self, wanted: Wanted) -> _Shared:
        shared = self._shared.pop(wanted, None)
        if shared is None:
            topic, type_, given = wanted
            # With `keep_all`, publishers would wait for a reader of every message.
            newest = replace(given, depth=1, history="keep_last")
            shared = _Shared(self._subscribe(topic, type_, qos=newest))
            if not self._has_closer:  # not at the end of a call: the node may be closed then
                self._has_closer = True
                self._tasks.start_soon(self._close_unused, name="close unused subscriptions")
            for key in [key for key, one in self._shared.items() if not one.waiting]:
                if len(self._shared) >= MOST_SHARED:
                    self._shared.pop(key).subscription.close()
        self._shared[wanted] = shared
        return shared

    async def _close_unused(self) -> None:
        """Close each subscription some time after its last use."""
        while True:
            due = min(map(_closing_time, self._shared.values()), default=inf)
            if due == inf:
                await self._news.wait()
                continue
            await anyio.sleep_until(due)
            now = anyio.current_time()
            for key in [key for key, one in self._shared.items() if _closing_time(one) <= now]:
                self._shared.pop(key).subscription.close()
