"""Questions to the servers of actions, and `GoalSearch` in what they and their histories answer.

A server that is silent does not delay the others.

The search asks any endpoint, so it is the same for goals in memory, in a file, at the brokers of a
fleet and behind a bridge. It finds each goal once, in any order. What does not fit is left out
where the history is read: in the thread of a file, or at the server of a connection. All goals are
counted, and few more are held than those that come before the end of the page.
"""

from __future__ import annotations

from collections.abc import Iterable
from heapq import nlargest, nsmallest
from typing import NamedTuple

import anyio

from fibaction.border.endpoints import Endpoint
from fibaction.border.event_loop import Slices
from fibaction.border.streams import StatusStream
from fibaction.words.action_error import ActionError
from fibaction.words.errors import ServerNotFound
from fibaction.words.goal_query import GoalQuery, place_of, sort_key
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.intake import Intake

ANSWERING = 5.0
"""Seconds within which a server answers, also if it is busy."""
ASKED_AT_ONCE = 100
"""Actions that are asked at the same time."""
INTAKES_TIMEOUT = 2.0
"""Seconds after which a list does not wait for more answers."""


async def intakes_of(endpoints: Iterable[Endpoint]) -> dict[str, Intake]:
    """Return how actions take goals, by their names.

    One that does not answer in time, or not to this client, is left out.
    """
    found: dict[str, Intake] = {}
    limit = anyio.CapacityLimiter(ASKED_AT_ONCE)

    async def ask(endpoint: Endpoint) -> None:
        try:
            async with limit:
                found[endpoint.info.name] = await endpoint.intake()
        except ActionError:
            return

    with anyio.move_on_after(INTAKES_TIMEOUT):
        async with anyio.create_task_group() as tasks:
            for endpoint in endpoints:
                if endpoint.absence is None:
                    tasks.start_soon(ask, endpoint)
    return found


async def statuses_soon(endpoint: Endpoint) -> StatusStream:
    """Return the statuses of all goals of an action, for a list that is waited for.

    A server that is frozen counts as away only after some heartbeats, and calls to it wait for it
    to come back.

    Raises:
        ServerNotFound: The server does not answer within `ANSWERING` seconds.
        ActionError: As for `Endpoint.status`.
    """
    with anyio.move_on_after(ANSWERING):
        return await endpoint.status()
    raise ServerNotFound(
        f"the server of {endpoint.info.name!r} has not answered for {ANSWERING:g} s: ask again"
    )


HELD = 2000
"""Goals that are held besides twice those up to the end of the page."""


class MatchingGoal(NamedTuple):
    """A goal that a search has found."""

    action: str
    info: GoalInfo


class GoalSearch:
    """One search: a page of the goals that are found, and the number of all of them."""

    def __init__(
        self,
        wanted: GoalQuery,
        sort: str,
        *,
        descending: bool,
        offset: int,
        limit: int,
        parent: GoalID | None = None,
    ) -> None:
        """Search these goals, or the children of `parent` among them, for so many of them after the
        first ones in an order of `SORTS`.
        """
        self.total = 0
        """The number of all goals that were found."""
        # Where the history is read, the children are found by the text that names their parent.
        words = wanted.words if parent is None else (str(parent), *wanted.words)
        self._wanted = wanted._replace(words=words)
        self._parent = parent
        self._sort = sort
        self._choose = nlargest if descending else nsmallest
        self._offset = offset
        self._most = offset + limit
        self._found: list[MatchingGoal] = []

    async def ask(self, endpoint: Endpoint) -> None:
        """Take the goals of an action.

        Raises:
            ActionError: Its server cannot be asked.
        """
        action = endpoint.info.name
        wanted = self._wanted.at(action)
        with await statuses_soon(endpoint) as statuses:
            known = await statuses.listed()
            ids = set(map(place_of, known))

            def take(infos: list[GoalInfo]) -> None:
                self._take(
                    MatchingGoal(action, info)
                    for info in infos
                    # Servers of earlier versions do not know all that is wanted.
                    if wanted.has(info) and place_of(info) not in ids
                )

            # Afterwards, so that a goal which is forgotten meanwhile is in one of them.
            await endpoint.read_past(wanted, take)
        slices = Slices()
        for info in known:
            if wanted.has(info):
                self._take([MatchingGoal(action, info)])
            await slices.pause()

    async def page(self) -> list[MatchingGoal]:
        """Return the page."""
        # In a thread, since a page far from the first goal takes longer than a slice.
        first = await anyio.to_thread.run_sync(self._first)
        return first[self._offset :]

    def _take(self, goals: Iterable[MatchingGoal]) -> None:
        before = len(self._found)
        self._found += filter(self._is_child, goals)
        self.total += len(self._found) - before
        if len(self._found) > HELD + 2 * self._most:
            self._found = self._first()

    def _is_child(self, goal: MatchingGoal) -> bool:
        parent = goal.info.parent
        return self._parent is None or (parent is not None and parent.goal_id == self._parent)

    def _first(self) -> list[MatchingGoal]:
        return self._choose(self._most, self._found, key=self._key)

    def _key(self, found: MatchingGoal) -> tuple[object, ...]:
        return (*sort_key(self._sort, found.info), found.action)
