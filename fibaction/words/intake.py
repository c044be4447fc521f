"""`Intake`: the way in which a server takes new goals of an action, and who has changed it.

A pause outlives the server if it has a store. To drain is about one server or worker until it
stops, since the next one is to take goals again.
"""

from __future__ import annotations

from datetime import UTC, datetime
from enum import Enum

import msgspec

from fibaction._runtime.text import LENGTH, excerpt, shortened

MOST_CHANGES = 50
"""Changes that are kept, the newest ones."""


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


class Intake(msgspec.Struct, frozen=True):
    """The way in which a server takes new goals of an action now, and the changes before."""

    mode: IntakeMode = IntakeMode.OPEN
    changes: tuple[IntakeChange, ...] = ()
    """The newest changes, newest first."""

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
        if self.mode is IntakeMode.OPEN:
            return ""
        what = "the server drains" if self.mode is IntakeMode.DRAIN else "the action is paused"
        change = self.current
        if change is None:
            return what
        since = datetime.fromtimestamp(change.at // 10**9, UTC).isoformat(timespec="seconds")
        by = f" by {excerpt(change.by)}" if change.by else ""
        reason = f": {excerpt(change.reason)}" if change.reason else ""
        return f"{what} since {since}{by}{reason}"


OPEN_INTAKE = Intake()
"""That of a server which nobody has paused, or which cannot be paused."""
