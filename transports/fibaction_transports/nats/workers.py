"""`FleetWorkers`: the workers of a fleet, as a client knows them from their leases.

One watch of the leases serves everything that a client does. It begins with the first question, and
lasts as long as the connection.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Absence, Notifier
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ConnectionLost, ProtocolError, ServerNotFound
from fibaction.words.goals import WorkerInfo
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerRecord, BrokerWatch
from fibaction_transports.nats.names import FleetNames, last_token
from fibaction_transports.nats.records import LeaseEntry, lease_entry

WATCH_PAUSE = 0.5
"""Seconds between attempts to watch the leases."""

logger = clean_logger("fibaction.nats")


class FleetWorkers:
    """The living workers of a fleet."""

    def __init__(self, broker: Broker, names: FleetNames, tasks: TaskGroup, timeout: float) -> None:
        """Watch in a task of `tasks`; the first answer may take `timeout` seconds."""
        self._broker = broker
        self._names = names
        self._tasks = tasks
        self.timeout = timeout
        """Seconds that the brokers have for a first list."""
        self._leases: dict[str, LeaseEntry] = {}  # by the last token of the subject
        self._known: dict[str, LeaseEntry] = {}  # by the name of the worker; living ones only
        # The claims to clear up after lost workers, by the last token of the subject.
        self._claims: dict[str, LeaseEntry] = {}
        self._is_watching = False
        self._is_listed = False
        self._is_closed = False
        self._absence: Absence | None = None
        self.news = Notifier()
        """The notifier of workers that come or go, and of actions that they begin or end to serve.
        """
        self._when_gone: list[Callable[[LeaseEntry], None]] = []

    async def ready(self) -> None:
        """Wait until the leases are known.

        Raises:
            ConnectionLost: The brokers do not answer, or the connection was closed.
        """
        self.check()
        if self._is_listed:
            return
        if not self._is_watching:
            self._is_watching = True
            self._tasks.start_soon(self._watch)
        with anyio.move_on_after(self.timeout):
            while not self._is_listed:
                await self.news.wait()
            return
        raise ConnectionLost(
            f"the brokers have not told the workers of the fleet within {self.timeout:g} s"
        )

    @property
    def absence(self) -> Absence | None:
        """The absence of the brokers, since this was asked first; None while there is a
        connection.
        """
        if self._broker.is_connected:
            self._absence = None
        elif self._absence is None:
            self._absence = Absence(time.time(), "the connection to the brokers is lost")
        return self._absence

    def check(self) -> None:
        """Raise an error if the connection was closed.

        Raises:
            ConnectionLost: It was closed.
        """
        if self._is_closed:
            raise ConnectionLost("the connection to the fleet was closed here")

    def when_gone(self, callback: Callable[[LeaseEntry], None]) -> None:
        """Call a function with the lease of each worker that has ended, or whose name another one
        has now; also when the claim to clear up after it has ended, as that survivor may be lost,
        too.
        """
        self._when_gone.append(callback)

    def close(self) -> None:
        """Let `ready` raise from now on."""
        self._is_closed = True
        self.news.notify()

    def living(self) -> list[LeaseEntry]:
        """Return the leases of all workers, in the order of their names."""
        return sorted(self._known.values(), key=lambda lease: lease.worker)

    def get(self, worker: str) -> LeaseEntry | None:
        """Return the lease of a worker; None if it has none."""
        return self._known.get(worker)

    @property
    def longest_lease(self) -> float:
        """The longest lease of a worker, in seconds."""
        return max((lease.lease for lease in self._leases.values()), default=self.timeout)

    def has(self, worker: str, incarnation: bytes) -> bool:
        """Return whether exactly this worker is alive, and not another one of its name."""
        lease = self._known.get(worker)
        return lease is not None and lease.incarnation == incarnation

    def serving(self, action: str, *, is_kept: bool | None = None) -> list[LeaseEntry]:
        """Return the leases of the workers that serve an action; with `is_kept`, only of those
        whose goals have records, or have none.
        """
        return [
            lease
            for lease in self.living()
            for served in lease.actions
            if served.info.name == action and is_kept in (None, served.is_kept)
        ]

    def is_kept(self, worker: str, action: str) -> bool:
        """Return whether a worker's goals of an action have records; True if it is not known."""
        lease = self._known.get(worker)
        served = () if lease is None else lease.actions
        return all(one.is_kept for one in served if one.info.name == action)

    def actions(self) -> list[ActionInfo]:
        """Return the actions of all workers, each once."""
        found: dict[str, ActionInfo] = {}
        for lease in self.living():
            for served in lease.actions:
                found.setdefault(served.info.name, served.info)
        return list(found.values())

    def infos(self) -> list[WorkerInfo]:
        """Return what users are told of the workers."""
        return [
            WorkerInfo(
                lease.worker,
                tuple(served.info.name for served in lease.actions),
                lease.since,
                lease.goals,
                lease.has_room,
                {one.info.name: one.unreadable for one in lease.actions if one.unreadable},
                lease.version,
            )
            for lease in self.living()
        ]

    def not_served(self, action: str) -> ServerNotFound:
        """Return the error for an action that no worker serves."""
        known = ", ".join(sorted(repr(info.name) for info in self.actions())) or "nothing"
        return ServerNotFound(
            f"the action {excerpt(action)!r} is not served in this fleet: there is {known}"
        )

    async def _watch(self) -> None:
        while True:
            try:
                subject = self._names.worker()
                async with self._broker.watch(self._names.workers, subject) as watch:
                    await self._follow(watch)
            except BrokerAway as exc:
                logger.debug("the leases cannot be watched: %s", exc)
                await anyio.sleep(WATCH_PAUSE)

    async def _follow(self, watch: BrokerWatch) -> None:
        while True:
            records = await watch.next()
            if records is None:
                if self._is_listed:
                    await self._look_again()
                self._is_listed = True
                self.news.notify()
            else:
                for record in records:
                    self._take(record)

    async def _look_again(self) -> None:
        """Forget the workers whose lease has ended while the watch was interrupted.

        If the stream was lost, they have the time of a lease to write theirs again.
        """
        for token, lease in (*self._leases.items(), *self._claims.items()):
            stream = self._names.workers
            record = await self._broker.get(stream, self._names.worker(lease.worker))
            if record is None and await self._broker.is_new(stream, self.longest_lease):
                self._tasks.start_soon(self._look_later)
                return
            if record is None or not record.data:
                self._forget(token)

    async def _look_later(self) -> None:
        while True:
            await anyio.sleep(WATCH_PAUSE)
            try:
                return await self._look_again()
            except BrokerAway as exc:
                logger.debug("the leases cannot be looked at: %s", exc)

    def _take(self, record: BrokerRecord) -> None:
        token = last_token(record.subject)
        lease: LeaseEntry | None = None
        try:
            lease = lease_entry(record.data) if record.data else None
        except ProtocolError as exc:
            logger.warning("%s: %s", record.subject, exc)
        if record.data:
            self._claims.pop(token, None)
        if lease is None or not lease.incarnation:
            self._forget(token)
            if lease is not None and lease.cleared_by:
                self._claims[token] = lease
            return
        before = self._leases.get(token)
        if before is not None and before.incarnation != lease.incarnation:
            self._forget(token)
        self._leases[token] = self._known[lease.worker] = lease
        if before is None or before.actions != lease.actions:
            self.news.notify()

    def _forget(self, token: str) -> None:
        lease = self._leases.pop(token, None)
        if lease is not None:
            self._known.pop(lease.worker, None)
            self._tell_gone(lease)
            self.news.notify()
        claim = self._claims.pop(token, None)
        if claim is not None:
            self._tell_gone(claim)

    def _tell_gone(self, lease: LeaseEntry) -> None:
        for callback in self._when_gone:
            callback(lease)
