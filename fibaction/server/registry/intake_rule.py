"""`IntakeRule`: the consequences of a pause for the goals of a server."""

from __future__ import annotations

from fibaction.words.intake import Intake, IntakeMode


class IntakeRule:
    """The consequences for the goals of one server."""

    def __init__(self) -> None:
        self.holds = False
        """True if no goal begins that waits."""
        self.busy = ""
        """The reason for which new goals are rejected; empty if they are not."""

    def follow(self, intake: Intake) -> None:
        """Let goals wait, and reject new ones, by an intake."""
        self.holds = intake.mode is not IntakeMode.OPEN
        self.busy = f"busy: {intake.text}" if intake.mode is IntakeMode.REFUSE else ""
