"""`Intake`: the way in which a server takes new goals of an action, and who has changed it; and
`ScheduleInfo`, the limits by which it runs them.

A pause outlives the server if it has a store. To drain is about one server or worker until it
stops, since the next one is to take goals again.
"""

from __future__ import annotations

from datetime import UTC, datetime
from enum import Enum
from typing import Annotated, TypeAlias

import msgspec

from fibaction._runtime.text import LENGTH, excerpt, shortened

MOST_CHANGES = 50
"""Changes that are kept, the newest ones."""
MOST_GOALS = 2**31 - 1
"""The largest limit that is told; a larger one is told as this."""
LONGEST_TIME = 1e9
"""The longest time that is told, in seconds; a longer one is told as none."""
GoalCount: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=MOST_GOALS)]
TimeLimit: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=LONGEST_TIME)]
WHEN_FULL = {
    "preempt": "a new goal ends the one that has run longest",
    "replace": "a new goal replaces the newest that waits",
}
"""Phrases about the goal that gives way to a new one."""


class IntakeMode(Enum):
    """The fate of a new goal."""

    OPEN = "open"
    """It is accepted, and runs when it has its turn."""
    HOLD = "hold"
    """It is accepted and waits, as those do that have not begun. The others run to their ends."""
    REFUSE = "refuse"
    """It is rejected as busy. Goals that have not begun wait, and the others run to their ends."""
    DRAIN = "drain"
    """It is rejected as busy, unless an active goal has sent it. All others run to their ends."""


class IntakeChange(msgspec.Struct, frozen=True):
    """A change by an operator."""

    mode: IntakeMode
    reason: str = ""
    """The reason, as the operator has given it; may be empty."""
    by: str = ""
    """The operator: the client as its server knows it, with the name that it gives itself."""
    at: int = 0
    """The time of the change: nanoseconds since 1970."""
    worker: str = ""
    """The only worker of a fleet that the change is about; empty for all of them."""


class ScheduleInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """The limits of a server, of which each is absent if there is none: see `Schedule`."""

    max_goals: GoalCount | None = None
    """The number of goals that may be active or be decided upon at the same time."""
    concurrency: GoalCount | None = None
    """The number of goals that run at the same time, for each key."""
    total: GoalCount | None = None
    """The number of goals that run at the same time, for all keys together."""
    queue: GoalCount = 0
    """The number of goals that may wait, for each key."""
    is_keyed: bool = False
    """True if goals have keys, each with a limit and a queue of its own."""
    has_priority: bool = False
    """True if more urgent goals start first."""
    when_full: str = "reject"
    """The goal that gives way when there is no place: `reject`, `preempt` or `replace`."""
    queue_timeout: TimeLimit | None = None
    """The seconds that a goal may wait."""
    run_timeout: TimeLimit | None = None
    """The seconds that a goal may run."""
    fleet_limit: str = ""
    """The name of the limit that all workers of a fleet have together."""

    @property
    def text(self) -> str:
        """A phrase about it, for people."""
        each = " for each key" if self.is_keyed else ""
        runs: list[str] = []
        if self.concurrency is not None:
            where = f" at all workers together ({excerpt(self.fleet_limit)})"
            runs.append(f"{_run(self.concurrency)}{each}{where if self.fleet_limit else ''}")
        if self.total is not None:
            runs.append(f"{self.total} in total" if runs else _run(self.total))
        parts = [", ".join(runs) or "all goals run at once"]
        if self.queue:
            order = ", the most urgent first" if self.has_priority else ""
            wait = "" if self.queue_timeout is None else f" for {self.queue_timeout:g} s at most"
            parts.append(f"{self.queue} may wait{each}{wait}{order}")
        if self.run_timeout is not None:
            parts.append(f"each runs for {self.run_timeout:g} s at most")
        if self.when_full in WHEN_FULL:
            parts.append(WHEN_FULL[self.when_full])
        return "; ".join(parts)


def _run(count: int) -> str:
    return "1 goal runs at a time" if count == 1 else f"{count} goals run at a time"


def told_count(limit: int | None) -> int | None:
    """Return a limit as it is told."""
    return None if limit is None else min(limit, MOST_GOALS)


def told_time(seconds: float) -> float | None:
    """Return a time limit as it is told."""
    return float(seconds) if seconds <= LONGEST_TIME else None


class Intake(msgspec.Struct, frozen=True):
    """The way in which a server takes new goals of an action now, and the changes before."""

    mode: IntakeMode = IntakeMode.OPEN
    changes: tuple[IntakeChange, ...] = ()
    """The newest changes, newest first."""
    schedule: ScheduleInfo | None = None
    """The limits of the server, in a fleet those of one of its workers; None if they are not told.
    A store does not keep them."""
    has_levers: bool = True
    """False if it cannot be changed from here: the server, or the way to it, has no levers."""

    def changed(self, change: IntakeChange, *, is_noted: bool = False) -> Intake:
        """Return the intake after a change, which is kept in full. A change to what is already so
        for the same reason is none.

        One that is only noted changes no mode; to drain is noted.
        """
        is_noted = is_noted or change.mode is IntakeMode.DRAIN
        newest = self.current
        is_so = change.mode is self.mode and (newest is None or change.reason == newest.reason)
        if is_so and not is_noted:
            return self
        change = msgspec.structs.replace(
            change, reason=shortened(change.reason, LENGTH), by=shortened(change.by, LENGTH)
        )
        changes = (change, *self.changes)[:MOST_CHANGES]
        return Intake(self.mode if is_noted else change.mode, changes)

    @property
    def current(self) -> IntakeChange | None:
        """The change to the present mode; None if it is open, or if that is not known."""
        if self.mode is IntakeMode.OPEN:
            return None
        return next((change for change in self.changes if change.mode is self.mode), None)

    @property
    def text(self) -> str:
        """A sentence about it without a full stop; empty if it is open."""
        return self._text(has_name=True)

    @property
    def text_for_all(self) -> str:
        """The same without the name of the operator, for clients that may not observe."""
        return self._text(has_name=False)

    def _text(self, *, has_name: bool) -> str:
        if self.mode is IntakeMode.OPEN:
            return ""
        what = "the server drains" if self.mode is IntakeMode.DRAIN else "the action is paused"
        change = self.current
        if change is None:
            return what
        since = datetime.fromtimestamp(change.at // 10**9, UTC).isoformat(timespec="seconds")
        by = f" by {excerpt(change.by)}" if change.by and has_name else ""
        reason = f": {excerpt(change.reason)}" if change.reason else ""
        return f"{what} since {since}{by}{reason}"


OPEN_INTAKE = Intake()
"""That of a server which nobody has paused."""
FIXED_INTAKE = Intake(has_levers=False)
"""That of a server which cannot be paused."""
NO_LEVERS = "it cannot be paused or drained from here: its server, or the way to it, has no levers"
"""The sentence about such a server."""
