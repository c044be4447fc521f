"""`FleetHistory`: the goals of the past of one action of a fleet, as its brokers keep them.

Theory of operation
-------------------

A goal of the past is a record of the stream of the history, under a subject with its ID and its
stamp. The worker that has ended the goal adds it (`HistoryWrites`), and it never changes; the
broker removes the oldest ones. Clients and workers read it here, whether a worker lives or not.

A record has a head: what a list tells of the goal, some hundred bytes, which the broker gives
without the rest. The records are in the order of the ends, and a page is in that of the
acceptances. So for a page all heads of the action are read that may belong to it, and of those as
many are held as the page has. With `since`, the reading begins there: no goal ends before it was
accepted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from heapq import nlargest, nsmallest

import anyio

from fibaction.border.event_loop import Slices
from fibaction.border.goal_store import NotGivenUp, PastSource, StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction.words.errors import ConnectionLost, ProtocolError, StoreError
from fibaction.words.goal_query import MOST_PAST, GoalQuery, PastPage, Place, place_of
from fibaction.words.goals import GoalID, GoalInfo
from fibaction_transports.nats.broker.broker import Broker, BrokerAway, BrokerRecord, BrokerWatch
from fibaction_transports.nats.history.given_up import rerun_goal
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import goal_entry, past_goal

HISTORY_TIMEOUT = 10.0
"""Seconds within which the brokers tell more of the history."""
HELD = 4
"""A page that is being read holds at most so many times the goals that it will have."""
BETWEEN_LOOKS = 32
"""Records that are read between two looks at the clock, which take a third of a millisecond."""
SKEW = 3600 * 10**9
"""Nanoseconds by which the clocks of a worker and of a broker may differ."""

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
