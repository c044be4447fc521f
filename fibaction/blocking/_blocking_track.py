"""`track`: the progress of a goal on one line, for programs without an event loop."""

from __future__ import annotations

from contextlib import closing
from typing import Any, TextIO

from fibaction.blocking._blocking_goal import BlockingGoal
from fibaction.client.track import ProgressLine
from fibaction.types.action import ResultT


def track(
    goal: BlockingGoal[Any, ResultT], text: str = "", *, file: TextIO | None = None
) -> ResultT:
    """Read the feedback of a goal, show its progress on one line, and return its result.

    For example:

        with client.send_goal(files) as goal:
            copied = track(goal, "copying")

    The line is that of `fibaction.track`.

    Raises:
        GoalAborted, GoalCanceled, GoalTimeout, UnknownGoal: As for `BlockingGoal.result`.
        ActionError: As for `BlockingGoal.result`.
    """
    with closing(ProgressLine(text, file)) as line:
        for feedback in goal.feedback:
            line.show(feedback, goal.feedback.number)
        result = goal.result()
        line.fill()
    return result
