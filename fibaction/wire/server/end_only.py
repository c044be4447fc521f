"""`EndOnly`: a stream of a goal that has ended, for a client that asks once more."""

from __future__ import annotations

from collections.abc import Sequence

from fibaction._runtime.notify import Notifier
from fibaction.border.abc import GoalStream, GoalUpdate
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalInfo, Outcome
from fibaction.words.statuses import GoalStatus


class EndOnly(GoalStream):
    """One more stream of a goal that has ended, which has the outcome and no feedback."""

    __slots__ = ("_stream", "cursor", "goal_id", "latest", "news", "reads", "stamp")

    def __init__(self, stream: GoalStream) -> None:
        self.goal_id, self.stamp, self.latest = stream.goal_id, stream.stamp, stream.latest
        self.cursor = stream.cursor
        self.reads = False
        self.news = Notifier()
        self._stream = stream

    @property
    def status(self) -> GoalStatus:
        return self._stream.status

    @property
    def attempt(self) -> int:
        return self._stream.attempt

    @property
    def info(self) -> GoalInfo:
        return self._stream.info

    @property
    def dropped(self) -> int:
        return self._stream.cursor - self.cursor

    def take(self, limit: int = 1) -> Sequence[GoalUpdate]:
        outcome = self.known_outcome()
        self.cursor = self._stream.cursor
        return () if outcome is None else (outcome,)

    def known_outcome(self) -> Outcome[bytes] | None:
        return self._stream.known_outcome()

    def seek(self, cursor: int) -> None:
        self.cursor = min(cursor, self._stream.cursor)

    def hold(self, wanted: bool) -> None:
        """Do nothing: there is no executor any more."""

    def close(self) -> None:
        """Do nothing: only the outcome is delivered anyway."""

    def fail(self, error: ActionError) -> None:
        """Do nothing: the outcome is known."""
