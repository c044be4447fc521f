"""The thread that spins a node of fibaction's own, and the waitable that takes what has arrived.

Theory of operation
-------------------

rclpy's executor collects everything of a node again each time that it wakes, in Python, and wraps
what is ready in a task of its own. That took a quarter of the time of a goal, while the event loop
waited for the interpreter. So the thread has a wait set of its own, which lasts until the handles
change, and takes from the sources of the node's `RosWaitable` directly.

The waitable takes everything that is there for each handle, and puts it into a `Mailbox`. The event
loop decides what becomes of it. The thread runs no code of users and no rule of actions, and raises
nothing: an exception would end the spinning.

The node has a few things of rclpy's own, too: the service that describes its types, and with
`use_sim_time` the clock of the simulation. The wait set has them as well. If one of them is ready,
rclpy's executor handles it.
"""

from __future__ import annotations

import atexit
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack, suppress
from threading import Lock
from types import TracebackType
from typing import Any

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import text_of
from fibaction_transports.ros2.node.mailbox import MAILBOX, TURN, Mailbox, Sink
from fibaction_transports.ros2.on_rclpy.rcl import (
    GuardCondition,
    InvalidHandle,
    ReentrantCallbackGroup,
    SignalHandlerGuardCondition,
    SingleThreadedExecutor,
    raw,
    waitable,
)

logger = clean_logger("fibaction.ros2")


class Source(ABC):
    """A raw handle, and the sink of what arrives there."""

    kind: str
    """The handle's kind, as the wait set names it."""

    def __init__(self, handle: Any, sink: Sink, unread: Sink | None = None) -> None:
        """`unread` is called with the error if something cannot be taken."""
        self.handle = handle
        self.index: int | None = None
        self.is_paused = False
        """True if nothing is to be taken for now, so that it waits in the middleware."""
        self._sink = sink
        self._unread = unread

    @abstractmethod
    def take(self) -> Any:
        """Take what has arrived first; None if there is nothing."""

    def take_all(self) -> list[tuple[Sink, Any]]:
        """Take all that has arrived, each with its sink."""
        items: list[tuple[Sink, Any]] = []
        failures = 0
        while len(items) < MAILBOX and failures < TURN:
            try:
                item = self.take()
            except InvalidHandle:
                break  # it has just been destroyed
            except Exception as exc:
                # For instance, text that is not valid Unicode. The middleware has dropped it.
                failures += 1
                logger.error("a message could not be taken: %s", exc)
                if self._unread is not None:
                    items.append((self._unread, exc))
            else:
                if item is None:
                    break
                items.append((self._sink, item))
        return items


class Requests(Source):
    """The requests to a service: `(header, request)`."""

    kind = "service"

    def __init__(self, handle: Any, service_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = service_type.Request

    def take(self) -> Any:
        request, header = self.handle.service_take_request(self._type)
        return None if header is None else (header.request_id, request)


class Responses(Source):
    """The responses of a service: `(number of the request, response)`."""

    kind = "client"

    def __init__(
        self, handle: Any, service_type: Any, sink: Sink, unread: Sink | None = None
    ) -> None:
        super().__init__(handle, sink, unread)
        self._type = service_type.Response

    def take(self) -> Any:
        header, response = self.handle.take_response(self._type)
        return None if header is None else (header.request_id.sequence_number, response)


class Messages(Source):
    """The messages of a topic: `(message, publisher)`. The message is bytes, because most may be
    ignored. The publisher is its GID; empty if the middleware or rclpy does not tell it.
    """

    kind = "subscription"

    def __init__(self, handle: Any, message_type: Any, sink: Sink) -> None:
        super().__init__(handle, sink)
        self._type = message_type

    def take(self) -> Any:
        taken = self.handle.take_message(self._type, True)
        if taken is None:
            return None
        message, info = taken
        publisher: Any = info.get("publisher_gid")
        return message, publisher["data"] if publisher else b""


_COUNTS = {
    "subscription": "num_subscriptions",
    "service": "num_services",
    "client": "num_clients",
}


class RosWaitable(waitable.Waitable):  # type: ignore[misc]  # rclpy has no types here
    """Takes from its sources whatever arrives, spun by a `Spinner` or by an executor of rclpy."""

    def __init__(self, mailbox: Mailbox) -> None:
        waitable.Waitable.__init__(self, ReentrantCallbackGroup())
        self._mailbox = mailbox
        self._lock = Lock()
        self._sources: tuple[Source, ...] = ()
        self._entered: list[Source] = []
        self._ready: list[Source] = []
        self.is_spun = False
        """True if an executor has waited for it."""

    def add(self, *sources: Source, first: bool = False) -> None:
        """Take from these sources, too. It has an effect after the executor has been woken.

        Items that have arrived together are put in the order of the sources, and taken in the
        reverse order. So feedback that was sent before a result is also handled before it, if its
        source is added first, or later with `first`.
        """
        with self._lock:
            self._sources = sources + self._sources if first else self._sources + sources

    @property
    def is_paused(self) -> bool:
        """True if nothing is to be taken for now, because the mailbox is full."""
        return self._mailbox.is_full

    def remove(self, handle: Any) -> None:
        """Take no more from the source with this handle, if there is one."""
        with self._lock:
            self._sources = tuple(one for one in self._sources if one.handle is not handle)

    def clear(self) -> None:
        """Remove all sources."""
        with self._lock:
            self._sources = ()

    # Methods that are called in the thread that spins, in this order

    def __enter__(self) -> RosWaitable:
        self.is_spun = True
        self._entered = []
        for source in () if self.is_paused else self._sources:
            if source.is_paused:
                continue
            with suppress(InvalidHandle):  # it is being destroyed
                source.handle.__enter__()
                self._entered.append(source)
        return self

    def get_num_entities(self) -> Any:
        number = waitable.NumberOfEntities()
        for source in self._entered:
            name = _COUNTS[source.kind]
            setattr(number, name, getattr(number, name) + 1)
        return number

    def add_to_wait_set(self, wait_set: Any) -> None:
        for source in self._entered:
            source.index = getattr(wait_set, f"add_{source.kind}")(source.handle)

    def is_ready(self, wait_set: Any) -> bool:
        self._ready = [
            source for source in self._entered if wait_set.is_ready(source.kind, source.index)
        ]
        return bool(self._ready)

    def take_data(self) -> None:
        taken: list[tuple[Sink, Any]] = []
        ready = {id(source) for source in self._ready}
        for source in reversed(self._entered):
            # If a result is ready, its feedback may have arrived since the wait: take that, too.
            if id(source) in ready or (taken and source.kind == "subscription"):
                taken[:0] = source.take_all()
        self._mailbox.put(taken)

    async def execute(self, taken_data: None) -> None:
        """Do nothing: `take_data` has done all."""

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_val: BaseException | None,
        exc_tb: TracebackType | None,
    ) -> None:
        for source in self._entered:
            source.handle.__exit__(exc_type, exc_val, exc_tb)


FOREVER = -1


class Spinner:
    """A thread that spins a node."""

    def __init__(
        self, node: Any, sources: RosWaitable, context: Any, on_end: Callable[[str], None]
    ) -> None:
        """Prepare the thread. The node must not have `sources` as a waitable. `on_end` is called in
        the thread, with the reason, if it ends before `stop`.
        """
        self._node = node
        self._sources = sources
        self._on_end = on_end
        self._context = context
        self._woken = GuardCondition(None, None, context=context)
        # With rclpy's own handlers of signals, Ctrl-C shuts down all contexts of the process.
        self._signal = SignalHandlerGuardCondition(context)
        self._executor = _Executor(context, self._wake)
        self._executor.add_node(node)
        self._is_stopping = False
        # A daemon, because Python waits for other threads before it ends. A program that ends
        # while C++ waits in this thread would crash, so `stop` is also called at exit.
        self._thread = threading.Thread(target=self._run, name="fibaction-ros2", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        atexit.register(self.stop)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and wait for it, which takes a moment. A second call does nothing."""
        atexit.unregister(self.stop)
        if not self._is_stopping:
            self._is_stopping = True
            self._wake()
            self._thread.join()
            self._executor.shutdown()
            self._woken.destroy()
            self._signal.destroy()

    def _wake(self) -> None:
        with suppress(InvalidHandle):  # the thread has been stopped
            self._woken.trigger()

    def _run(self) -> None:
        reason = "rclpy was shut down"
        try:
            while self._goes_on():
                self._take_until_woken()
        except BaseException as exc:
            # If ROS is shut down between a look at the context and the next wait, rclpy raises
            # whatever rcl says.
            if self._context.ok():
                reason = f"the thread of rclpy has ended: {text_of(exc)}"
                logger.error("%s", reason, exc_info=exc)
        if not self._is_stopping:
            self._on_end(reason)

    def _goes_on(self) -> bool:
        return not self._is_stopping and self._context.ok()

    def _take_until_woken(self) -> None:
        """Take everything that arrives, until the handles of the node may have changed."""
        with ExitStack() as held, self._sources as sources:
            others = _Others(self._node, held)
            counts = others.get_num_entities() + sources.get_num_entities()
            counts.num_guard_conditions += 2
            for handle in (self._context.handle, self._woken.handle, self._signal.handle):
                held.enter_context(handle)
            wait_set = raw.WaitSet(
                counts.num_subscriptions,
                counts.num_guard_conditions,
                counts.num_timers,
                counts.num_clients,
                counts.num_services,
                counts.num_events,
                self._context.handle,
            )
            woken = False
            while not woken and self._goes_on():
                wait_set.clear_entities()
                wake = wait_set.add_guard_condition(self._woken.handle)
                wait_set.add_guard_condition(self._signal.handle)
                try:
                    others.add_to_wait_set(wait_set)
                except InvalidHandle:  # its destruction was requested since the last wait
                    return
                sources.add_to_wait_set(wait_set)
                wait_set.wait(FOREVER)
                woken = wait_set.is_ready("guard_condition", wake)
                if sources.is_ready(wait_set):
                    sources.take_data()
                    woken = woken or sources.is_paused
                if others.are_ready(wait_set) and self._goes_on():
                    self._executor.spin_once(timeout_sec=0)


class _Executor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy has no types here
    """The executor of rclpy for the rest of a node. It also wakes the thread of the spinner."""

    def __init__(self, context: Any, on_wake: Callable[[], None]) -> None:
        self._on_wake = on_wake
        SingleThreadedExecutor.__init__(self, context=context)

    def wake(self) -> None:
        SingleThreadedExecutor.wake(self)
        self._on_wake()


class _Others:
    """The handles of a node that are rclpy's own, as one thing to wait for."""

    def __init__(self, node: Any, held: ExitStack) -> None:
        """Keep the handles in use until `held` is closed."""
        self._handles = [
            (kind, one.handle)
            for kind, ones in (
                ("subscription", node.subscriptions),
                ("timer", node.timers),
                ("client", node.clients),
                ("service", node.services),
            )
            for one in ones
            if _is_entered(one.handle, held)
        ]
        self._waitables = [one for one in node.waitables if _is_entered(one, held)]
        self._indexes: list[tuple[str, int]] = []

    def get_num_entities(self) -> Any:
        number = waitable.NumberOfEntities()
        for kind, _ in self._handles:
            name = f"num_{kind}s"
            setattr(number, name, getattr(number, name) + 1)
        for one in self._waitables:
            number += one.get_num_entities()
        return number

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._indexes = [
            (kind, getattr(wait_set, f"add_{kind}")(handle)) for kind, handle in self._handles
        ]
        for one in self._waitables:
            one.add_to_wait_set(wait_set)

    def are_ready(self, wait_set: Any) -> bool:
        return any(wait_set.is_ready(kind, index) for kind, index in self._indexes) or any(
            one.is_ready(wait_set) for one in self._waitables
        )


def _is_entered(one: Any, held: ExitStack) -> bool:
    try:
        held.enter_context(one)
    except InvalidHandle:  # it is being destroyed
        return False
    return True
