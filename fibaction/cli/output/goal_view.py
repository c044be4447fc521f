"""The goals that the screen of `fibaction top` lists: those that match a filter, in an order."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fibaction.cli.arguments.action_names import shown
from fibaction.cli.output.family import step_of
from fibaction.cli.output.goal_table import GoalRow
from fibaction.observe.monitor import GoalKey, GoalSnapshot, Monitor, Snapshot, newest_active_first

SETTLING = 2
"""Pictures with goals in which a cursor that was not moved stays at the top: the goals that there
are arrive one by one, and the user has not chosen one of them yet."""


def _by_age(goal: GoalSnapshot) -> tuple[Any, ...]:
    return not goal.info.status.is_active, goal.info.stamp


def _by_action(goal: GoalSnapshot) -> tuple[Any, ...]:
    return goal.action, newest_active_first(goal.info)


def _by_status(goal: GoalSnapshot) -> tuple[Any, ...]:
    return goal.info.status, -goal.info.stamp


def _by_rate(goal: GoalSnapshot) -> tuple[Any, ...]:
    return -goal.feedback_rate, newest_active_first(goal.info)


ORDERS: Mapping[str, Callable[[GoalSnapshot], tuple[Any, ...]]] = {
    "newest first": lambda goal: newest_active_first(goal.info),
    "oldest first": _by_age,
    "by action": _by_action,
    "by status": _by_status,
    "by feedback rate": _by_rate,
}
"""The orders of goals and their names, in the order in which the user meets them."""


class GoalView:
    """A part of a monitor's goals, as the user has asked for it."""

    def __init__(self, monitor: Monitor, most: int) -> None:
        """Make a view of at most so many goals."""
        self._monitor = monitor
        self._most = most
        self._orders: Sequence[str] = tuple(ORDERS)
        self._settling = SETTLING
        self.filter = ""
        """The words that a goal must have, in its action, ID, status, client, step or parent's ID.
        One that begins with `/` is one or several whole parts of the action's name."""
        self.keys: list[GoalKey] = []
        """The goals of the last snapshot, from above."""

    @property
    def order(self) -> str:
        """The name of the order."""
        return self._orders[0]

    def next_order(self) -> None:
        """Take the next order."""
        self._orders = (*self._orders[1:], self._orders[0])

    def snapshot(self) -> Snapshot:
        """Return the state of the monitor now, with the goals of this view."""
        words = self.filter.lower().split()

        def matches(goal: GoalSnapshot) -> bool:
            if not words:
                return True
            row = GoalRow(goal.action, goal.info)
            action = shown(row.action).lower()
            step = step_of(row.info.parent) if row.info.parent else ""
            text = f"{row.goal_id} {action} {row.status} {row.client} {step}".lower()
            return all(
                _has_parts(action, word) if word.startswith("/") else word in text for word in words
            )

        found = self._monitor.snapshot(self._most, matches=matches, order=ORDERS[self.order])
        self.keys = [goal.key for goal in found.goals]
        return found

    def key_at(self, place: int) -> GoalKey | None:
        """Return the goal at a place from above; None if there is none."""
        return self.keys[place] if 0 <= place < len(self.keys) else None

    def place_of(self, selected: GoalKey | None, before: int) -> int:
        """Return the place of the cursor, which was on a goal and at a place before.

        It stays on its goal when the goal moves. Without that goal it is at the top.
        """
        if before == 0 and self._settling:
            self._settling -= bool(self.keys)
            return 0
        if selected is None or selected not in self.keys:
            return 0
        return self.keys.index(selected)


def _has_parts(name: str, parts: str) -> bool:
    """Return whether a name has these parts, one after another: `/robot1` is not `/robot10`."""
    return f"{parts.rstrip('/')}/" in f"{name}/"
