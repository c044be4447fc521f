"""A session of Zenoh: what arrives in its threads, and a thread that sends.

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

Both queues are bounded in bytes. Beyond the bound, messages of topics are dropped, counted and
told in the log; requests and answers are not, since there is one answer for each request.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final, TypeVar

import anyio
import zenoh
from anyio import to_thread

from fibaction.border.event_loop import Background
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError, text_of
from fibaction_transports.ros2.node.mailbox import Mailbox
from fibaction_transports.ros2.on_zenoh.config import Configuration

MOST_BYTES: Final = 64 * 1024 * 1024
"""Bytes that may wait to be sent, or for the event loop, before messages of topics are dropped."""

ItemT = TypeVar("ItemT")

logger = clean_logger("fibaction.ros2")


class QueuedBytes:
    """The bytes in a queue: one thread puts them in, and another one takes them out."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._put = 0
        self._taken = 0
        self.dropped = 0
        """Messages that were dropped."""

    def put(self, size: int) -> None:
        """Note bytes that have been put in."""
        self._put += size

    def take(self, size: int) -> None:
        """Note bytes that have been taken out."""
        self._taken += size

    def has_room(self) -> bool:
        """Return whether a message may be put in; otherwise it is dropped, and counted."""
        if self._put - self._taken < MOST_BYTES:
            return True
        self.dropped += 1
        if self.dropped & (self.dropped - 1) == 0:  # 1, 2, 4, 8 and so on
            logger.warning("%d messages were dropped: %s", self.dropped, self._what)
        return False


class SendingThread:
    """A thread that sends, since that may have to wait."""

    def __init__(self) -> None:
        self.held = QueuedBytes("the network is too slow for what is sent")
        self._queue: SimpleQueue[tuple[Callable[[], object], int] | None] = SimpleQueue()
        self._thread = Thread(target=self._run, name="fibaction-zenoh", daemon=True)
        self._thread.start()

    def send(self, act: Callable[[], object], size: int) -> None:
        """Send something of so many bytes, after all that was sent before."""
        self.held.put(size)
        self._queue.put((act, size))

    def close(self) -> None:
        """Send what is left, and end the thread."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            act, size = item
            try:
                act()
            except zenoh.ZError as exc:
                logger.info("something could not be sent: %s", text_of(exc))
            finally:
                self.held.take(size)


class ZenohSession:
    """An open session."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.zid = str(session.zid())
        """The ID of the session."""
        self.is_closed = False
        self.sender = SendingThread()
        self.inbox = QueuedBytes("more has arrived than this program takes")
        """The bytes of messages that wait for the event loop."""
        self.mailbox = Mailbox(lambda: None)
        self._kept: list[Any] = []

    def handler(
        self, take: Callable[[ItemT], None], end: Callable[[], None] | None = None
    ) -> zenoh.handlers.Callback[ItemT]:
        """Return a handler whose items `take` gets on the event loop. `end` is called there when
        no more will come.
        """
        put = self.mailbox.put

        def ended(_: None) -> None:
            assert end is not None
            end()

        return zenoh.handlers.Callback(
            lambda item: put([(take, item)]),
            (lambda: put([(ended, None)])) if end else None,
            indirect=False,
        )

    def message_handler(
        self, take: Callable[[zenoh.Sample], None]
    ) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a handler of messages, some of which are dropped if too many wait."""
        held, put = self.inbox, self.mailbox.put

        def taken(sample: zenoh.Sample) -> None:
            held.take(len(sample.payload))
            take(sample)

        def arrived(sample: zenoh.Sample) -> None:
            if held.has_room():
                held.put(len(sample.payload))
                put([(taken, sample)])

        return zenoh.handlers.Callback(arrived, indirect=False)

    def query_handler(
        self, take: Callable[[zenoh.Query], None]
    ) -> zenoh.handlers.Callback[zenoh.Query]:
        """Return a handler of requests. If too many wait, more end without an answer."""
        held, put = self.inbox, self.mailbox.put

        def taken(query: zenoh.Query) -> None:
            held.take(_size(query))
            take(query)

        def arrived(query: zenoh.Query) -> None:
            if held.has_room():
                held.put(_size(query))
                put([(taken, query)])
            else:
                query.drop()

        return zenoh.handlers.Callback(arrived, indirect=False)

    def keep(self, *declared: Any) -> None:
        """Keep declarations until the session is closed: what is not kept is undeclared."""
        self._kept += declared

    def close(self) -> None:
        """Send what is left, and close. It may take a moment, so not on the event loop."""
        self.is_closed = True
        self.sender.close()
        self.session.close()
        self._kept.clear()


def _size(query: zenoh.Query) -> int:
    payload = query.payload
    return 0 if payload is None else len(payload)


@asynccontextmanager
async def open_session(configuration: Configuration) -> AsyncGenerator[ZenohSession, None]:
    """Open a session for as long as the block lasts.

    Raises:
        TransportError: A configuration is not valid, or in mode `client` no router answers.
    """
    try:
        # A thread of its own: without a router, it takes half a second.
        opened = await to_thread.run_sync(lambda: zenoh.open(configuration.made()))
    except zenoh.ZError as exc:
        advice = configuration.advice(exc)
        raise TransportError(f"cannot open a session of Zenoh: {advice}") from exc
    session = ZenohSession(opened)
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
