"""`LeaseThread`: renews the lease of a worker while an executor blocks its event loop.

Each renewal has a connection of its own, which belongs to the event loop of the thread, and is
closed after it: they are needed rarely. What is renewed, and when, is in `Membership`.
"""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from threading import Event, Thread
from typing import TypeAlias

import anyio

from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import TransportError
from fibaction_transports.nats.broker.broker import Broker, BrokerAway
from fibaction_transports.nats.worker.lease import MARGIN, Membership

LOOKS_IN_A_LEASE = 16
"""The number of looks in the time of one lease."""
JOIN_TIMEOUT = 1.0
"""Seconds for the thread to end. It ends at once, unless it is renewing the lease."""
TEXT = (
    "worker %r: its event loop is blocked, and a thread renews the lease: its goals stay here, and"
    " answer nobody meanwhile"
)

OpenBroker: TypeAlias = Callable[[], AbstractAsyncContextManager[Broker]]
"""Opens a connection to the brokers in the event loop that runs."""

logger = clean_logger("fibaction.nats")


class LeaseThread(Thread):
    """The thread that renews the lease of one worker, if its event loop does not."""

    def __init__(self, membership: Membership, open_broker: OpenBroker) -> None:
        super().__init__(name=f"fibaction lease {membership.worker}", daemon=True)
        self._membership = membership
        self._open_broker = open_broker
        self._stopped = Event()

    async def stop(self) -> None:
        """Renew nothing more, and wait for the end of the thread, also if canceled."""
        self._stopped.set()
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(self.join, JOIN_TIMEOUT)

    def run(self) -> None:
        """Look whether the event loop is blocked, again and again."""
        me, told_at = self._membership, 0.0
        while not self._stopped.wait(me.lease / LOOKS_IN_A_LEASE):
            if me.is_blocked(time.monotonic()):
                if told_at != me.alive_at:
                    told_at = me.alive_at
                    logger.warning(TEXT, me.worker)
                try:
                    anyio.run(self._renew, backend="asyncio")
                except (BrokerAway, TransportError) as exc:
                    logger.warning("worker %r: the lease is not renewed: %s", me.worker, exc)

    async def _renew(self) -> None:
        with anyio.move_on_after(self._membership.lease * MARGIN):
            async with self._open_broker() as broker:
                await self._membership.renew_blocked(broker)


@asynccontextmanager
async def lease_thread(
    membership: Membership, open_broker: OpenBroker
) -> AsyncGenerator[None, None]:
    """Renew the lease of a worker whose event loop is blocked, while the block lasts."""
    thread = LeaseThread(membership, open_broker)
    try:
        thread.start()
    except RuntimeError as exc:  # the system has no threads, or no more of them
        logger.warning("goals that block worker %r are lost for it: %s", membership.worker, exc)
        yield
        return
    try:
        yield
    finally:
        await thread.stop()
