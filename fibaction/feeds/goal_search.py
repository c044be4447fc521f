"""`GoalSearch`: the goals that servers know and those of their histories, each once, in any order.

It asks any endpoint, so it is the same for goals in memory, in a file, at the brokers of a fleet
and behind a bridge. What does not fit is left out where the history is read: in the thread of a
file, or at the server of a connection. All goals are counted, and few more are held than those
that come before the end of the page.
"""

from __future__ import annotations

from collections.abc import Iterable
from heapq import nlargest, nsmallest
from typing import NamedTuple

import anyio

from fibaction.border.endpoints import Endpoint
from fibaction.border.event_loop import Slices
from fibaction.feeds.answers import statuses_soon
from fibaction.words.goal_query import GoalQuery, place_of, sort_key
from fibaction.words.goals import GoalID, GoalInfo

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
