"""The history of a fleet: goals of the past, which workers add and clients read, and those that
were given up.

Theory of operation
-------------------

A goal of the past is a record of the stream of the history, under a subject with its ID and its
stamp. The worker that has ended the goal adds it (`HistoryWrites`), and it never changes; the
broker removes the oldest ones. Clients and workers read it (`FleetHistory`), whether a worker lives
or not.

A record has a head: what a list tells of the goal, some hundred bytes, which the broker gives
without the rest. The records are in the order of the ends, and a page is in that of the
acceptances. So for a page all heads of the action are read that may belong to it, and of those as
many are held as the page has. With `since`, the reading begins there: no goal ends before it was
accepted.

The end of a goal is told when its record is stored, and that record stays for a minute at least.
The goal is added to the history afterwards, in the background, by a copy of the record together
with the request, which the record of an end does not have. A write that has no answer is made
again; it stores the goal only if the history does not have it, so it is there once.

A worker may be killed between the two. Then another one that finds the record of the end, while it
clears up after the lost worker or looks for goals without one, adds the goal, without its request.

A history that cannot be written must not stop the fleet. A goal for which there is no room is left
out with a line in the log, and so are those that end while too much waits to be added.

A goal that was given up has its request and its checkpoint in its own record, so it is listed from
there (`given_up_goals`), and run again as a new goal (`rerun_goal`), with or without a history.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from copy import copy
from heapq import nlargest, nsmallest
from typing import NamedTuple, TypeAlias

import anyio
from anyio.abc import TaskGroup

from fibaction.border.abc import Notifier
from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import NotGivenUp, PastSource, StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost, ProtocolError, StoreError
from fibaction.words.goal_query import MOST_PAST, GoalQuery, PastPage, Place, place_of
from fibaction.words.goals import GoalID, GoalInfo
from fibaction_transports.nats.broker.broker import (
    Broker,
    BrokerAway,
    BrokerRecord,
    BrokerWatch,
    PutError,
    PutFailure,
)
from fibaction_transports.nats.names import FleetNames, action_of
from fibaction_transports.nats.records import (
    NONCE_SIZE,
    ROOM_TO_GROW,
    GoalEntry,
    encode,
    goal_entry,
    past_goal,
    time_to_live,
)

HISTORY_TIMEOUT = 10.0
"""Seconds within which the brokers tell more of the history."""
HELD = 4
"""A page that is being read holds at most so many times the goals that it will have."""
BETWEEN_LOOKS = 32
"""Records that are read between two looks at the clock, which take a third of a millisecond."""
SKEW = 3600 * 10**9
"""Nanoseconds by which the clocks of a worker and of a broker may differ."""
FIRST_PAUSE, LONGEST_PAUSE = 0.02, 1.0
"""Seconds until a write without an answer is made again."""
MOST_WAITING = 2**24
"""Bytes of goals that wait to be added, at most."""
LAST_WRITES = 5.0
"""Seconds that a worker that leaves waits for goals to be added."""
CLEARING = 10.0
"""Seconds within which the others read all records after a worker is lost."""
MOST_SEEN = 10_000
"""Records of goals of lost workers that are remembered as added."""

IsGone: TypeAlias = Callable[[GoalEntry], Awaitable[bool]]
"""Returns whether the worker of a goal is gone."""

logger = clean_logger("fibaction.nats")


class FleetHistory(PastSource):
    """The goals of the past of one action of a fleet."""

    def __init__(self, broker: Broker, names: FleetNames, action: str) -> None:
        self.action = action
        self._broker = broker
        self._names = names

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        """See `PastSource.past_goals`."""
        limit = min(page.limit, MOST_PAST)
        found: dict[Place, GoalInfo] = {}  # a record may come again

        def take(infos: list[GoalInfo]) -> None:
            nonlocal found
            found |= {place_of(info): info for info in infos if page.has(info)}
            if len(found) > HELD * limit:
                found = first_of(found, page)

        await self._read(page.wanted, take)
        return list(first_of(found, page).values())

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """See `PastSource.read_past`: each page would read all records, so all are read once."""
        known: set[Place] = set()

        def take_new(infos: list[GoalInfo]) -> None:
            places = {place_of(info): info for info in infos}
            take([info for place, info in places.items() if place not in known])
            known.update(places)

        await self._read(wanted, take_new)

    async def _read(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        since = wanted.since
        slices = Slices()
        try:
            async with self._broker.watch(
                self._names.history,
                self._names.past(self.action),
                heads_since=0 if since is None else max(0, min(since, time.time_ns()) - SKEW),
            ) as watch:
                while (records := await _next(watch)) is not None:
                    infos: list[GoalInfo] = []
                    for place, record in enumerate(records):
                        goal = _goal_in(record)
                        if goal is not None and wanted.has(info := goal.info):
                            infos.append(info)
                        if place % BETWEEN_LOOKS == 0:
                            await slices.pause()
                    take(infos)
        except BrokerAway as exc:
            raise StoreError(f"the history of the fleet cannot be read: {exc}") from exc

    async def past_goal(self, goal_id: GoalID) -> StoredGoal | None:
        """See `PastSource.past_goal`."""
        newest: StoredGoal | None = None
        subject = self._names.past(self.action, goal_id)
        try:
            async with self._broker.watch(self._names.history, subject) as watch:
                while (records := await _next(watch)) is not None:
                    for goal in filter(None, map(_goal_in, records)):
                        if newest is None or goal.stamp > newest.stamp:
                            newest = goal
        except BrokerAway as exc:
            raise StoreError(f"the history of the fleet cannot be read: {exc}") from exc
        return newest

    async def given_up(self, goal_id: GoalID) -> StoredGoal | None:
        """See `PastSource.given_up`."""
        subject = self._names.goal(self.action, goal_id)
        try:
            record = await self._broker.get(self._names.goals, subject)
            goal = goal_entry(record.data).goal if record is not None and record.data else None
        except (BrokerAway, ProtocolError) as exc:
            raise StoreError(f"the record of goal {goal_id} cannot be read: {exc}") from exc
        return goal if goal is not None and goal.is_given_up else None

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        """See `PastSource.rerun`: one of the workers gets the new goal."""
        try:
            return await rerun_goal(self._broker, self._names, self.action, goal_id)
        except NotGivenUp:
            return None
        except ConnectionLost as exc:
            raise StoreError(str(exc)) from exc


async def _next(watch: BrokerWatch) -> list[BrokerRecord] | None:
    """Return the next records of a watch; None after the last one.

    Raises:
        BrokerAway: None has come in time.
    """
    try:
        with anyio.fail_after(HISTORY_TIMEOUT):
            return await watch.next()
    except TimeoutError:
        raise BrokerAway(f"no answer within {HISTORY_TIMEOUT:g} s") from None


def first_of(found: Mapping[Place, GoalInfo], page: PastPage) -> dict[Place, GoalInfo]:
    """Return the goals of a page, in its order, of those that belong to it or to one after it."""
    choose = nlargest if page.newest_first else nsmallest
    return {place: found[place] for place in choose(min(page.limit, MOST_PAST), found)}


def _goal_in(record: BrokerRecord) -> StoredGoal | None:
    """Return the goal in a record or in its head; None if it cannot be read, as one of a later
    version.
    """
    try:
        return past_goal(record.data)
    except ProtocolError as exc:
        logger.debug("%s: %s", record.subject, exc)
        return None


# What workers add


class _Past(NamedTuple):
    """A goal that is to be added."""

    subject: str
    head: bytes
    data: bytes

    @property
    def size(self) -> int:
        return len(self.head) + len(self.data)


class HistoryWrites:
    """The goals that one worker adds to the history."""

    def __init__(self, broker: Broker, names: FleetNames) -> None:
        self.least_ttl = 1.0
        """Seconds for which the record of an end is kept at least."""
        self._tasks: TaskGroup | None = None
        self._broker = broker
        self._names = names
        self._waiting: dict[str, _Past] = {}  # by subject
        self._size = 0  # their bytes
        self._is_short = False  # goals are left out
        self._seen: set[int] = set()  # the sequences of records whose goals were added
        self._settled = Notifier()

    def open(self, tasks: TaskGroup, lease: float) -> None:
        """Add goals from now on; without this, none are added."""
        self._tasks = tasks
        self.least_ttl = 2 * lease + CLEARING  # so that others find the ends of a lost worker

    def add(self, action: str, ended: StoredGoal, sent: StoredGoal) -> None:
        """Add a goal that has ended, with the request and the meta that it had before."""
        if self._tasks is None:
            return
        past = copy(ended)
        past.goal, past.meta, past.checkpoint = sent.goal, sent.meta, None
        head = encode(past.listed())
        most = self._broker.max_record - 2 * len(head)  # it is sent as text
        if len(data := encode(past)) > most:
            past.goal = b""
            data = encode(past)
        if len(data) > most:
            past.result = None
            data = encode(past)
        self._add(_Past(self._names.past(action, past.goal_id, past.stamp), head, data))

    async def add_left(self, record: BrokerRecord, entry: GoalEntry, is_gone: IsGone) -> None:
        """Add the goal of a record if it has ended, and its worker is gone, which may not have
        added it.

        Raises:
            BrokerAway: The brokers do not answer.
        """
        goal = entry.goal
        if self._tasks is None or not goal.ended_at or record.sequence in self._seen:
            return
        if await is_gone(entry):
            if len(self._seen) >= MOST_SEEN:
                self._seen.clear()  # it is harmless to add them again
            self._seen.add(record.sequence)
            self.add(action_of(record.subject), goal, goal)

    def _add(self, past: _Past) -> None:
        if self._waiting and self._size + past.size > MOST_WAITING:
            self._leave_out("too many goals wait to be added")
        elif past.subject not in self._waiting:
            self._waiting[past.subject] = past
            self._size += past.size
            self._send(past, FIRST_PAUSE)

    def _send(self, past: _Past, pause: float) -> None:
        def answered(answer: int | PutError) -> None:
            if isinstance(answer, PutError) and answer.kind is PutFailure.UNKNOWN:
                assert self._tasks is not None
                self._tasks.start_soon(self._send_again, past, pause)
                return
            if isinstance(answer, int):
                self._is_short = False
            elif answer.kind is not PutFailure.REFUSED:  # then it is there already
                self._leave_out(answer.text)
            self._forget(past)

        self._broker.put(past.subject, past.data, expected=0, head=past.head, then=answered)

    async def _send_again(self, past: _Past, pause: float) -> None:
        await anyio.sleep(pause)
        self._send(past, min(2 * pause, LONGEST_PAUSE))

    def _forget(self, past: _Past) -> None:
        del self._waiting[past.subject]
        self._size -= past.size
        if not self._waiting:
            self._settled.notify()

    def _leave_out(self, why: str) -> None:
        if not self._is_short:
            self._is_short = True
            logger.warning(
                "goals that end now may be missing in the history of fleet %r: %s (stream %s)",
                self._names.fleet,
                why,
                self._names.history,
            )

    async def settle(self) -> None:
        """Wait until all goals are added, for some seconds at most."""
        with anyio.move_on_after(LAST_WRITES):
            while self._waiting:
                await self._settled.wait()


# Goals that were given up


async def given_up_goals(broker: Broker, names: FleetNames) -> dict[str, list[StoredGoal]]:
    """Return the goals of a fleet that were given up, by their actions, in the order of their ends.

    Raises:
        ConnectionLost: The brokers do not answer.
    """
    found: dict[str, list[StoredGoal]] = {}
    slices = Slices()
    try:
        async with broker.watch(names.goals, names.all_goals()) as watch:
            while (records := await watch.next()) is not None:
                for record in records:
                    goal = goal_entry(record.data).goal if record.data else None
                    if goal is not None and goal.is_given_up:
                        found.setdefault(action_of(record.subject), []).append(goal)
                    await slices.pause()
    except BrokerAway as exc:
        raise ConnectionLost(f"the goals of the fleet cannot be listed: {exc}") from exc
    for goals in found.values():
        goals.sort(key=lambda goal: goal.ended_at)
    return found


async def rerun_goal(broker: Broker, names: FleetNames, action: str, goal_id: GoalID) -> GoalID:
    """Store a new goal for one that was given up, and return its ID. A worker takes it, and
    runs it from the checkpoint of the old one, of which only the outcome is kept.

    Raises:
        NotGivenUp: The goal was not given up, or runs again already.
        StoreError: It cannot be stored.
        ConnectionLost: The brokers do not answer.
    """
    subject = names.goal(action, goal_id)
    try:
        record = await broker.get(names.goals, subject)
    except BrokerAway as exc:
        raise ConnectionLost(f"the record of goal {goal_id} cannot be read: {exc}") from exc
    entry = goal_entry(record.data) if record is not None and record.data else None
    if record is None or entry is None or not entry.goal.is_given_up:
        raise NotGivenUp(f"goal {goal_id} was not given up, or is not kept any more")
    new = entry.goal.as_new(time.time_ns())
    nonce = secrets.token_bytes(NONCE_SIZE) + bytes(ROOM_TO_GROW)
    to_run = names.goal(action, new.goal_id)
    stored = await _put(broker, to_run, GoalEntry(new, b"", nonce), 0)
    if isinstance(stored, PutError):
        if stored.kind is PutFailure.REFUSED:
            raise NotGivenUp(f"goal {goal_id} runs again already, as goal {new.goal_id}")
        raise StoreError(f"goal {goal_id} cannot be run again: {stored.text}")
    broker.add_note(names.left(action), bytes(new.goal_id))
    entry.goal.drop_request()
    await _put(broker, subject, entry, record.sequence)
    return new.goal_id


async def _put(broker: Broker, subject: str, entry: GoalEntry, expected: int) -> int | PutError:
    """Store a record, and return the answer."""
    ttl = time_to_live(entry.goal, time.time_ns())
    return await broker.put_and_wait(subject, encode(entry), expected=expected, ttl=ttl)
