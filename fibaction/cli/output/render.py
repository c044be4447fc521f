"""Printing of one goal's events: as text as `ros2 action` does, on a live line, or as JSON."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from fibaction.border.abc import FeedbackItem, GoalStream
from fibaction.cli.output.escape import clean
from fibaction.cli.output.goal_table import parent_json, step_of
from fibaction.cli.output.lines import console, log_connection, note, on_terminal, say, say_json
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.types.action import Action
from fibaction.words.errors import GoalRejected
from fibaction.words.goals import GoalID, Outcome, Parent
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.cli.output.progress import LiveLine

INDENT = 4
"""Spaces in front of a goal, a feedback or a result, as `ros2 action` prints them."""

CODES = {
    GoalStatus.SUCCEEDED: ExitCode.SUCCEEDED,
    GoalStatus.CANCELED: ExitCode.CANCELED,
    GoalStatus.ABORTED: ExitCode.ABORTED,
    GoalStatus.UNKNOWN: ExitCode.ABORTED,  # the server has forgotten how it ended
}
"""The exit code for each status of a goal that has ended."""


class TextPrinter:
    """Prints the events of one goal as lines, as `ros2 action send_goal` does."""

    wants_all = False
    """True if statuses are printed as well; for those the feedback has to be read, too."""

    def __init__(self, *, full: bool = False, line: LiveLine | None = None) -> None:
        """Make a printer. With `line`, each feedback is shown there until the next one."""
        self._full = full
        self._line = line

    def sending(self, goal: Any) -> None:
        """Print the goal, before it is sent."""
        self._say("Sending goal:", goal)

    def accepted(self, goal_id: GoalID, stamp: int, parent: Parent | None = None) -> None:
        """Print that the server has accepted it, and the goal whose step it is, if it is one."""
        step = f"It is the step {step_of(parent)}\n" if parent else ""
        say(f"Goal accepted with ID: {goal_id}\n{step}")

    def rejected(self, error: GoalRejected) -> None:
        """Print that the server has rejected it."""
        reason = clean(error.reason)
        say(f"Goal was rejected: {reason}" if reason else "Goal was rejected.")

    def status(self, status: GoalStatus) -> None:
        """Print nothing: the verb prints a remark when it causes a change."""

    def feedback(self, item: FeedbackItem, feedback: Any) -> None:
        """Print a feedback message."""
        if self._line is not None:
            self._line.show(item.number, feedback)
        else:
            self._say("Feedback:", feedback)

    def ended(self, outcome: Outcome[Any]) -> None:
        """Print how it ended."""
        if outcome.result is not None:
            self._say("Result:", outcome.result)
        reason = f" ({clean(outcome.reason)})" if outcome.reason else ""
        say(f"Goal finished with status: {outcome.status.name}{reason}")

    def given_up(self, checkpoint: Any) -> None:
        """Print the last checkpoint of a goal that its server has given up; None if it has none."""
        what = "Its server has given it up, and can run it again"
        if checkpoint is None:
            say(f"{what} from its beginning.")
        else:
            self._say(f"{what} from its checkpoint:", checkpoint)

    def _say(self, title: str, value: Any) -> None:
        say(f"{title}\n{as_yaml(value, full=self._full, indent=INDENT)}\n")


class JsonPrinter(TextPrinter):
    """Prints each event of a goal as one JSON object, with nothing left out."""

    wants_all = True

    def __init__(self, *, feedback: bool) -> None:
        super().__init__()
        self._feedback = feedback

    def sending(self, goal: Any) -> None:
        pass

    def accepted(self, goal_id: GoalID, stamp: int, parent: Parent | None = None) -> None:
        more = {"parent": parent_json(parent)} if parent else {}
        say_json({"event": "accepted", "goal_id": str(goal_id), "stamp": stamp, **more})

    def rejected(self, error: GoalRejected) -> None:
        goal_id, reason, code = str(error.goal_id), error.reason, error.code.name
        say_json({"event": "rejected", "goal_id": goal_id, "reason": reason, "code": code})

    def status(self, status: GoalStatus) -> None:
        say_json({"event": "status", "status": status.name})

    def feedback(self, item: FeedbackItem, feedback: Any) -> None:
        if self._feedback:
            facts = {"number": item.number, "at": item.at}
            say_json({"event": "feedback", **facts, "feedback": feedback})

    def ended(self, outcome: Outcome[Any]) -> None:
        say_json({"event": "result"} | outcome.members)

    def given_up(self, checkpoint: Any) -> None:
        say_json({"event": "given_up", "checkpoint": checkpoint})


def goal_printer(*, feedback: bool, as_json: bool, full: bool) -> TextPrinter:
    """Return the printer for these options of a command."""
    return JsonPrinter(feedback=feedback) if as_json else TextPrinter(full=full)


async def print_goal(
    stream: GoalStream, action: Action[Any, Any, Any], printer: TextPrinter, *, live: bool
) -> ExitCode:
    """Print the events of a goal until it ends, and return the exit code for its end.

    With `live`, the feedback is on one line if stdout is a terminal.

    Raises:
        ConnectionLost: The connection ended before the goal did.
        ProtocolError: The server sent what cannot be read.
    """
    log_connection()
    with stream:
        with _live_line(printer, live) as shown:
            async for update in stream:
                if isinstance(update, FeedbackItem):
                    shown.feedback(update, action.feedback.decode(update.payload))
                elif isinstance(update, GoalStatus):
                    shown.status(update)
        raw = await stream.outcome()
    if stream.dropped:
        note(
            f"{stream.dropped} feedback messages were missed: they came faster than they were read"
        )
    printer.ended(raw.decoded(action.result.decode))
    return CODES[raw.status]


@contextmanager
def _live_line(printer: TextPrinter, wanted: bool) -> Generator[TextPrinter, None, None]:
    if printer.wants_all or not (wanted and on_terminal()):
        yield printer
        return
    from fibaction.cli.output.progress import LiveLine

    with LiveLine(console()) as line:
        yield TextPrinter(line=line)
