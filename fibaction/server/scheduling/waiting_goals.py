"""`WaitingGoals`: the goals that wait, their places, and which of them has waited longest."""

from __future__ import annotations

from collections.abc import Hashable
from heapq import heapify, heappop, heappush

from fibaction.server.scheduling.group import Entry
from fibaction.words.goals import GoalID


class WaitingGoals:
    """The waiting goals of all groups, in the order of their arrival.

    Most have also begun to wait in that order. A goal that an earlier process has accepted may have
    waited for longer than those that are here already.
    """

    def __init__(self) -> None:
        self._entries: dict[GoalID, Entry] = {}
        self._by_time: list[tuple[float, int, Entry]] = []

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, entry: Entry) -> None:
        """Add a goal, which waits from its `since` on."""
        self._entries[entry.goal_id] = entry
        if len(self._by_time) > 2 * len(self._entries) + 16:  # most are those that have left
            self._by_time = [_timed(one) for one in self._entries.values()]
            heapify(self._by_time)
        else:
            heappush(self._by_time, _timed(entry))

    def remove(self, goal_id: GoalID) -> None:
        """Remove a goal; if it does not wait, do nothing."""
        self._entries.pop(goal_id, None)

    def longest(self) -> Entry | None:
        """Return the goal that has waited longest; None if none waits."""
        while self._by_time:
            since, _, entry = self._by_time[0]
            # A goal that has started has another time, and one that was sent again another entry.
            if self._entries.get(entry.goal_id) is entry and entry.since == since:
                return entry
            heappop(self._by_time)
        return None

    def places(self) -> dict[GoalID, tuple[int, int]]:
        """Return the place of each goal, from 1, and the number that wait for its key."""
        places: dict[GoalID, tuple[int, int]] = {}
        groups: dict[Hashable, list[Entry]] = {}
        for entry in self._entries.values():
            groups.setdefault(entry.group.key, []).append(entry)
        for entries in groups.values():
            # Successors are ahead of the queue.
            entries.sort(key=lambda one: (one.predecessor is None, one.urgency))
            for place, entry in enumerate(entries, 1):
                places[entry.goal_id] = (place, len(entries))
        return places


def _timed(entry: Entry) -> tuple[float, int, Entry]:
    return entry.since, entry.urgency[1], entry
