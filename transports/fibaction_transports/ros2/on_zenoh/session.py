"""The session of Zenoh that the nodes of a process share, and a node's part of it: what arrives in
its threads, and a thread that sends.

Theory of operation
-------------------

The library of Zenoh calls back in the thread that has read from the network, and the whole link
waits meanwhile. So a callback only puts what has arrived into the mailbox of the event loop, which
handles it in the order of arrival.

A message may have to wait until its link has capacity again: Zenoh would drop it otherwise. It
does so in one thread that sends everything of a session in its order, so feedback is sent before
the result that follows it, and the event loop never waits.

On the event loop, only methods of the library are called that release the interpreter while they
wait for a lock, as those do that declare something. `Session.is_closed` does not: a thread that has
the lock may be about to call back, and waits for the interpreter.

Both queues are bounded in bytes. Beyond the bound, messages of topics, requests and new tokens are
dropped, counted and told in the log. Answers are not: only the first one to a request is taken.

A session costs some threads, sockets and megabytes, so all nodes of a process share one for each
configuration. A process that was forked from one with a session cannot open another: the threads of
the library are not there, and opening would wait for them forever.
"""

from __future__ import annotations

import os
import re
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from itertools import count
from queue import SimpleQueue
from threading import Event, Lock, Thread
from typing import Any, Final, TypeVar

import anyio
import zenoh
from anyio import to_thread

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError, text_of
from fibaction_transports.ros2.node.mailbox import Drops, Mailbox
from fibaction_transports.ros2.on_zenoh.config import Configuration

MOST_BYTES: Final = 64 * 1024 * 1024
"""Bytes that may wait to be sent, or for the event loop, before messages of topics are dropped."""

OVERHEAD: Final = 500
"""Bytes that an item has in a queue beside its content."""

ItemT = TypeVar("ItemT")

logger = clean_logger("fibaction.ros2")


class QueuedBytes:
    """The bytes in a queue, which any thread puts in or takes out."""

    def __init__(self, what: str, why: str) -> None:
        self._why = why
        self._held = 0
        self._lock = Lock()
        self.drops = Drops(what)
        """The items that were dropped."""

    def change(self, size: int) -> None:
        """Note bytes that have been put in, or taken out if they are negative."""
        with self._lock:
            self._held += size

    def has_room(self) -> bool:
        """Return whether a message may be put in; otherwise it is dropped, and counted."""
        if self._held < MOST_BYTES:
            return True
        self.drops.note(self._why)
        return False


class SendingThread:
    """A thread that sends, since that may have to wait."""

    def __init__(self) -> None:
        self.held = QueuedBytes("a message of a topic", "the network is too slow for what is sent")
        self._queue: SimpleQueue[tuple[Callable[[], object], int] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="fibaction-zenoh", daemon=True)
        self._thread.start()

    def send(self, act: Callable[[], object], size: int) -> None:
        """Send something of so many bytes, after all that was sent before."""
        self.held.change(size)
        self._queue.put((act, size))

    def flush(self) -> None:
        """Wait until everything is sent that was to be sent before."""
        sent = Event()
        self.send(sent.set, 0)
        sent.wait()

    def close(self) -> None:
        """Send what is left, and end the thread."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            act, size = item
            try:
                act()
            except Exception as exc:  # whatever the library raises: others wait for this thread
                logger.info("something could not be sent: %s", text_of(exc))
            finally:
                self.held.change(-size)


class SharedSession:
    """An open session of this process."""

    def __init__(self, config: zenoh.Config) -> None:
        self.locators = re.sub(r'[]["]', "", config.get_json("connect/endpoints"))
        """The routers or peers to connect to."""
        self.session = zenoh.open(config)
        self.zid = str(self.session.zid())
        """The ID of the session."""
        self.sender = SendingThread()
        self.numbers = count()
        """Numbers for nodes and their ends."""
        self.users = 0
        """The nodes that use it."""

    def close(self) -> None:
        """Send what is left, and close."""
        self.sender.close()
        try:
            self.session.close()
        except zenoh.ZError as exc:  # on a busy machine, after ten seconds
            logger.info("a session of Zenoh goes on closing: %s", text_of(exc))


_OPEN: dict[tuple[str, ...], SharedSession] = {}
_OPENERS: set[int] = set()
"""The process that has opened a session; after a fork, that is another one."""
_LOCKS: dict[tuple[str, ...], Lock] = {}
"""The locks of the configurations, which are held while a session is opened or closed: the next
session may listen at the same port.
"""


def _join(configuration: Configuration) -> SharedSession:
    """Return the session of this process with a configuration; the first node opens it."""
    if _OPENERS - {os.getpid()}:
        raise TransportError(
            "Zenoh cannot be used in a process that was forked from one that has used it: use"
            ' multiprocessing with "spawn" or "forkserver", or fork before the first connection'
        )
    with _LOCKS.setdefault(configuration.key, Lock()):
        shared = _OPEN.get(configuration.key)
        if shared is None:
            _OPENERS.add(os.getpid())
            shared = _OPEN[configuration.key] = SharedSession(configuration.made())
        shared.users += 1
        return shared


def _leave(configuration: Configuration, shared: SharedSession) -> None:
    with _LOCKS[configuration.key]:
        shared.users -= 1
        if not shared.users:
            del _OPEN[configuration.key]
            shared.close()


@asynccontextmanager
async def _joined(configuration: Configuration) -> AsyncGenerator[SharedSession, None]:
    """Join a session for as long as the block lasts.

    asyncio can cancel the task itself, which no scope shields, while a thread opens the session. It
    is left then, too.
    """
    lock, found, has_left = Lock(), list[SharedSession](), Event()

    def join() -> None:
        with lock:
            if not has_left.is_set():
                found.append(_join(configuration))

    def leave() -> None:
        has_left.set()
        with lock:
            for shared in found:
                _leave(configuration, shared)

    try:
        try:
            # A thread of its own: without a router, it takes half a second.
            await to_thread.run_sync(join)
        except zenoh.ZError as exc:
            advice = configuration.advice(exc)
            raise TransportError(f"cannot open a session of Zenoh: {advice}") from exc
        yield found[0]
    finally:
        with anyio.CancelScope(shield=True):
            await to_thread.run_sync(leave)


class ZenohSession:
    """A node's part of a session."""

    def __init__(self, shared: SharedSession) -> None:
        self.session = shared.session
        self.locators = shared.locators
        self.zid = shared.zid
        self.numbers = shared.numbers
        self.is_closed = False
        self.sender = shared.sender
        self.inbox = QueuedBytes("a message", "more has arrived than this program takes")
        """The bytes of messages that wait for the event loop."""
        self.mailbox = Mailbox(lambda: None)
        self._kept: list[Any] = []

    def handler(self, take: Callable[[ItemT], None]) -> zenoh.handlers.Callback[ItemT]:
        """Return a handler whose items `take` gets on the event loop."""
        put = self.mailbox.put
        return zenoh.handlers.Callback(lambda item: put([(take, item)]), indirect=False)

    def reply_handler(
        self, take: Callable[[zenoh.Reply], None], end: Callable[[], None]
    ) -> zenoh.handlers.Callback[zenoh.Reply]:
        """Return a handler of answers to a request: of the first one, and of the first error. `end`
        is called when no more will come.
        """
        put, seen = self.mailbox.put, set[bool]()

        def arrived(reply: zenoh.Reply) -> None:
            is_error = reply.ok is None
            if is_error not in seen:
                seen.add(is_error)
                put([(take, reply)])

        return zenoh.handlers.Callback(
            arrived, lambda: put([(lambda _: end(), None)]), indirect=False
        )

    def sample_handler(
        self, take: Callable[[zenoh.Sample], None]
    ) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a handler of messages and tokens, some of which are dropped if too many wait.
        Tokens that go are not.
        """
        held, put = self.inbox, self.mailbox.put

        def taken(item: tuple[zenoh.Sample, int]) -> None:
            sample, size = item
            held.change(-size)
            take(sample)

        def arrived(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE or held.has_room():
                size = len(sample.payload) + OVERHEAD
                held.change(size)
                put([(taken, (sample, size))])

        return zenoh.handlers.Callback(arrived, indirect=False)

    def query_handler(
        self, take: Callable[[zenoh.Query], None]
    ) -> zenoh.handlers.Callback[zenoh.Query]:
        """Return a handler of requests. If too many wait, more end without an answer."""
        held, put = self.inbox, self.mailbox.put

        def taken(item: tuple[zenoh.Query, int]) -> None:
            query, size = item
            held.change(-size)
            take(query)

        def arrived(query: zenoh.Query) -> None:
            if held.has_room():
                payload = query.payload
                size = OVERHEAD + (0 if payload is None else len(payload))
                held.change(size)
                put([(taken, (query, size))])
            else:
                query.drop()

        return zenoh.handlers.Callback(arrived, indirect=False)

    def keep(self, declared: Any) -> None:
        """Keep a declaration until the session is closed: what is not kept is undeclared."""
        self._kept.append(declared)

    def remove(self, declared: Any) -> None:
        """Undeclare what was kept, after what was to be sent before."""
        if not self.is_closed:  # else it is undeclared with the session
            self._kept.remove(declared)
            self.sender.send(declared.undeclare, 0)

    def close(self) -> None:
        """Send what is left, and remove everything in the opposite order. It may take a moment, so
        not on the event loop.
        """
        self.is_closed = True
        self.sender.flush()
        for one in reversed(self._kept):
            with suppress(zenoh.ZError):  # the whole session is closed
                one.undeclare()
        self._kept.clear()


@asynccontextmanager
async def open_session(configuration: Configuration) -> AsyncGenerator[ZenohSession, None]:
    """Open a session for as long as the block lasts, or join that of another node.

    Raises:
        TransportError: A configuration is not valid, in mode `client` no router answers, or the
            process was forked from one with a session.
    """
    async with _joined(configuration) as shared:
        session = ZenohSession(shared)
        try:
            async with Background() as tasks:
                tasks.start_soon(session.mailbox.run, name="zenoh mailbox")
                try:
                    yield session
                finally:
                    with anyio.CancelScope(shield=True):
                        # The event loop runs meanwhile: callbacks may be under way.
                        await to_thread.run_sync(session.close)
        finally:
            session.mailbox.close()
