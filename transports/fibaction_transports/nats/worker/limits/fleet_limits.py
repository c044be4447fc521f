"""`FleetLimits`: the limits that one worker has together with the other workers of its fleet.

The stream of their records is made when the first server that needs it starts, so a fleet without
such limits has none. `FleetPlaces` is one limit; it has a `KeyTurns`, and a task for it, for each
key whose goals run or wait here.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from anyio import current_time, sleep
from anyio.abc import TaskGroup

from fibaction.border.goal_store import KeyPlaces
from fibaction.words.errors import StoreError, TransportError
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerSubscription,
    Message,
)
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.worker.lease import LONGEST_PAUSE, MemberPart, Membership
from fibaction_transports.nats.worker.limits.key_turns import KeyTurns
from fibaction_transports.nats.workers import FleetWorkers


class FleetLimits(MemberPart):
    """The limits of one worker."""

    def __init__(
        self,
        broker: Broker,
        names: FleetNames,
        membership: Membership,
        workers: FleetWorkers,
        tasks: TaskGroup,
        *,
        has_ended: Callable[[str, bytes], Awaitable[bool]],
        open_stream: Callable[[Callable[[], None]], Awaitable[None]],
    ) -> None:
        """Run in tasks of the worker. `open_stream` makes the stream of the records, and calls its
        argument each time it was lost and is there again.
        """
        self.broker = broker
        self.names = names
        self.membership = membership
        self.has_ended = has_ended
        """See `KeyFleet`."""
        self.tasks = tasks
        """The tasks of the worker."""
        self.turns: dict[str, KeyTurns] = {}
        """The turns at keys, by the subjects of their records."""
        self._workers = workers
        self._open_stream = open_stream
        self._limits: dict[str, FleetPlaces] = {}
        self._hints: BrokerSubscription | None = None
        membership.add(self)

    @property
    def longest_lease(self) -> float:
        """See `KeyFleet`."""
        return max(self._workers.longest_lease, self.membership.lease)

    async def places(self, limit: str, most: int) -> FleetPlaces:
        """Return the places of a limit: see `GoalJournal.key_places`.

        Raises:
            StoreError: The brokers do not answer.
        """
        until = current_time() + self.membership.lease
        while True:
            try:
                if self._hints is None:
                    subject = self.names.turn(self.membership.worker)
                    self._hints = await self.broker.subscribe(subject, self._on_hint)
                await self._open_stream(self._rewrite)
                break
            except (BrokerAway, TransportError) as exc:
                if current_time() >= until:
                    raise StoreError(
                        f"cannot join the fleet: fleet_limit={limit!r} cannot be used: {exc}"
                    ) from exc
            await sleep(LONGEST_PAUSE)
        places = self._limits.get(limit)
        if places is None:
            places = self._limits[limit] = FleetPlaces(self, limit)
        places.most = most
        return places

    def _on_hint(self, message: Message) -> None:
        turns = self.turns.get(message.data.decode("ascii", "replace"))
        if turns is not None:
            turns.look()

    def joined(self) -> None:
        """See `MemberPart.joined`: look at the records of all keys soon."""
        for turns in self.turns.values():
            turns.look()

    def _rewrite(self) -> None:
        for turns in self.turns.values():
            turns.rewrite()


class FleetPlaces(KeyPlaces):
    """The places of one limit, as one worker asks for them."""

    def __init__(self, limits: FleetLimits, limit: str) -> None:
        self.most = 0
        """The number of places of each key."""
        self._limits = limits
        self._limit = limit
        self._granted: Callable[[bytes], None] = _decline
        self._is_open = False
        self._turns: dict[bytes, KeyTurns] = {}

    def open(self, granted: Callable[[bytes], None]) -> None:
        """See `KeyPlaces.open`."""
        if self._is_open:
            raise ValueError(
                f"two schedules of this worker have fleet_limit={self._limit!r}: give their servers"
                f" the same Schedule object"
            )
        self._is_open, self._granted = True, granted

    def close(self) -> None:
        """See `KeyPlaces.close`."""
        self._is_open, self._granted = False, _decline
        for turns in self._turns.values():
            turns.note(0, 0)

    def note(self, key: bytes, running: int, asked: int) -> None:
        """See `KeyPlaces.note`."""
        turns = self._turns.get(key)
        if turns is None:
            if not (running or asked):
                return
            subject = self._limits.names.key(self._limit, key)
            turns = KeyTurns(self._limits, subject, key, self.most, self._grant)
            self._turns[key] = self._limits.turns[subject] = turns
            self._limits.tasks.start_soon(self._take_turns, subject, key)
        turns.note(running, asked)

    def _grant(self, key: bytes) -> None:
        self._granted(key)

    async def _take_turns(self, subject: str, key: bytes) -> None:
        await self._turns[key].run()
        del self._turns[key], self._limits.turns[subject]


def _decline(_key: bytes) -> None:
    """Let no goal begin."""
