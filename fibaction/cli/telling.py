"""How a goal's story is told: in words as `ros2 action` does, on a live line, or in JSON."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fibaction.abc import FeedbackItem, GoalStream
from fibaction.action import Action
from fibaction.cli.ending import ExitCode
from fibaction.cli.escaping import clean
from fibaction.cli.output import as_yaml, console, note, on_terminal, say, say_json
from fibaction.goals import GoalID, Outcome
from fibaction.states import GoalStatus

if TYPE_CHECKING:
    from fibaction.cli.progress import LiveLine

INDENT = 4
"""Blanks in front of a goal, a feedback or a result, as `ros2 action` has them."""

CODES = {
    GoalStatus.SUCCEEDED: ExitCode.SUCCEEDED,
    GoalStatus.CANCELED: ExitCode.CANCELED,
    GoalStatus.ABORTED: ExitCode.ABORTED,
    GoalStatus.UNKNOWN: ExitCode.ABORTED,  # the server has forgotten how it ended
}
"""The exit code for each end of a goal."""


class Teller(ABC):
    """Tells what happens to one goal."""

    wants_all = False
    """Whether the status is told as well, for which the feedback has to be read, too."""

    @abstractmethod
    def sending(self, goal: Any) -> None:
        """The goal is about to be sent."""

    @abstractmethod
    def accepted(self, goal_id: GoalID, stamp: int) -> None:
        """The server has accepted it."""

    @abstractmethod
    def rejected(self, goal_id: GoalID, reason: str) -> None:
        """The server has not."""

    @abstractmethod
    def status(self, status: GoalStatus) -> None:
        """It has another status."""

    @abstractmethod
    def feedback(self, number: int, feedback: Any) -> None:
        """There is feedback."""

    @abstractmethod
    def ended(self, outcome: Outcome[Any]) -> None:
        """It has ended."""


class Words(Teller):
    """Lines as `ros2 action send_goal` prints them."""

    def __init__(self, *, full: bool = False, line: LiveLine | None = None) -> None:
        """With `line`, feedback is shown there, and not for long."""
        self._full = full
        self._line = line

    def sending(self, goal: Any) -> None:
        self._say("Sending goal:", goal)

    def accepted(self, goal_id: GoalID, stamp: int) -> None:
        say(f"Goal accepted with ID: {goal_id}\n")

    def rejected(self, goal_id: GoalID, reason: str) -> None:
        say(f"Goal was rejected: {clean(reason)}" if reason else "Goal was rejected.")

    def status(self, status: GoalStatus) -> None:
        pass  # the words for it are said where it is brought about

    def feedback(self, number: int, feedback: Any) -> None:
        if self._line is not None:
            self._line.show(number, feedback)
        else:
            self._say("Feedback:", feedback)

    def ended(self, outcome: Outcome[Any]) -> None:
        if outcome.result is not None:
            self._say("Result:", outcome.result)
        reason = f" ({clean(outcome.reason)})" if outcome.reason else ""
        say(f"Goal finished with status: {outcome.status.name}{reason}")

    def _say(self, title: str, value: Any) -> None:
        say(f"{title}\n{as_yaml(value, full=self._full, indent=INDENT)}\n")


class Json(Teller):
    """One JSON object for each event, with nothing left out."""

    wants_all = True

    def __init__(self, *, feedback: bool) -> None:
        self._feedback = feedback

    def sending(self, goal: Any) -> None:
        pass

    def accepted(self, goal_id: GoalID, stamp: int) -> None:
        say_json({"event": "accepted", "goal_id": str(goal_id), "stamp": stamp})

    def rejected(self, goal_id: GoalID, reason: str) -> None:
        say_json({"event": "rejected", "goal_id": str(goal_id), "reason": reason})

    def status(self, status: GoalStatus) -> None:
        say_json({"event": "status", "status": status.name})

    def feedback(self, number: int, feedback: Any) -> None:
        if self._feedback:
            say_json({"event": "feedback", "number": number, "feedback": feedback})

    def ended(self, outcome: Outcome[Any]) -> None:
        say_json(
            {
                "event": "result",
                "status": outcome.status.name,
                "result": outcome.result,
                "reason": outcome.reason,
            }
        )


def teller(*, feedback: bool, as_json: bool, full: bool) -> Teller:
    """The teller for these options of a command."""
    return Json(feedback=feedback) if as_json else Words(full=full)


def log_connection() -> None:
    """Let the log say when the connection is lost, and when it is back: who waits for news wants to
    know why nothing happens.
    """
    logging.getLogger("fibaction.wire").setLevel(logging.INFO)


async def follow(
    stream: GoalStream, action: Action[Any, Any, Any], told: Teller, *, live: bool
) -> ExitCode:
    """Tell of a goal until it ends; gives the exit code for that. With `live`, the feedback is on
    one line if stdout is a terminal.

    Raises:
        ConnectionLost: The connection ended before the goal did.
        ProtocolError: The server sent what cannot be read.
    """
    log_connection()
    with stream:
        with _live_line(told, live) as shown:
            async for update in stream:
                if isinstance(update, FeedbackItem):
                    shown.feedback(update.number, action.feedback.decode(update.payload))
                elif isinstance(update, GoalStatus):
                    shown.status(update)
        raw = await stream.outcome()
    if stream.dropped:
        note(
            f"{stream.dropped} feedback messages were missed: they came faster than they were read"
        )
    result = None if raw.result is None else action.result.decode(raw.result)
    told.ended(Outcome(raw.status, result, raw.reason))
    return CODES[raw.status]


@contextmanager
def _live_line(told: Teller, wanted: bool) -> Generator[Teller, None, None]:
    if not (wanted and isinstance(told, Words) and on_terminal()):
        yield told
        return
    from fibaction.cli.progress import LiveLine

    with LiveLine(console()) as line:
        yield Words(line=line)
