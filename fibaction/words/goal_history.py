"""`GoalHistory`: how long a store keeps the goals that have ended, for lists of the past."""

from __future__ import annotations

import math
from typing import cast

from fibaction._runtime.settings_struct import SettingsStruct
from fibaction.words.plain_data import check_is_number

SECOND = 1_000_000_000
DAY = 24 * 3600.0


class GoalHistory(SettingsStruct, frozen=True, kw_only=True):
    """The bounds of a history: goals that have ended stay in the store until one is passed.

    For example:

        SqliteStore("goals.db", history=GoalHistory(seconds=7 * 24 * 3600, goals=10_000))
    """

    seconds: float = 30 * DAY
    """Seconds after its end for which a goal is kept; `math.inf` without this bound."""
    goals: int = 10_000
    """The number of goals that are kept, of all actions in the store together; those whose end is
    the longest ago go first."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: One of them is not a number.
            ValueError: One of them is out of range.
        """
        check_is_number("seconds", self.seconds)
        if not self.seconds > 0:
            raise ValueError(f"seconds must be more than 0, not {self.seconds}")
        goals = cast("object", self.goals)
        if not isinstance(goals, int):
            raise TypeError(f"goals must be a whole number, not {goals!r}")
        if goals < 1:
            raise ValueError(f"goals must be 1 or more, not {goals}")

    def earliest_end(self, now: int) -> int:
        """Return the time at or before which an end is too long ago at `now`, both in nanoseconds
        since 1970; -1 if no end is.
        """
        return -1 if math.isinf(self.seconds) else now - int(self.seconds * SECOND)


def check_is_history(value: object) -> None:
    """Raise TypeError for what is neither a history nor None."""
    if not (value is None or isinstance(value, GoalHistory)):
        raise TypeError(f"history must be a GoalHistory, not {value!r}")
