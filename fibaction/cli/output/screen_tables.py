"""The tables on the screen of `fibaction top`: the cells of each action and of each goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from rich.text import Text

from fibaction.cli.arguments.names import shown
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_details import GoalDetails
from fibaction.cli.output.goal_table import FAMILY, STYLES, Family, GoalRow, unambiguous
from fibaction.cli.output.progress import on_one_line, percent_bar, text_beside_bar
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import message_of
from fibaction.observe.monitor import ActionSnapshot, GoalKey, GoalSnapshot
from fibaction.words.progress import ProgressMeter

WIDE = 110
"""Width of a screen with room for the client, the parent and the children, too."""
BARS = {100: 10, 0: 0}
"""Widths of a bar, by the least width of the screen: a narrow one has room for the figure only."""
NUMBERS = ("ACTIVE", "ENDED", "FEEDBACK/S", "AGE", "FEEDBACK", "/S")
"""Columns that are aligned to the right."""
PADDING = 2
"""Spaces that a table puts around each cell."""
LEAST = 10
"""Least width of the last column; a table that is too wide can be scrolled."""


class FeedbackText(NamedTuple):
    """Feedback as text."""

    line: str
    """On one line, without the progress; large feedback is cut."""
    yaml: str
    """As YAML; large feedback is cut."""
    progress: dict[str, Any]
    """The fields that tell the progress of the goal, if there are some."""

    @classmethod
    def of(cls, feedback: Any) -> Self:
        """Make the texts of a feedback."""
        meter = ProgressMeter()
        progress, yaml = meter.read(feedback), as_yaml(feedback, indent=2)
        if progress is None or progress.fraction is None:
            return cls(on_one_line(feedback), yaml, {})
        line = text_beside_bar(feedback, progress, meter.fields)
        return cls(line, yaml, {name: feedback[name] for name in meter.fields})


class Table(NamedTuple):
    """The content of a table."""

    heads: list[str]
    rows: list[list[Text]]

    def widths(self, room: int) -> list[int]:
        """Return the widths of the columns; the last one gets what is left of the room."""
        texts = [[cell.plain for cell in row] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(self.heads, *texts, strict=True)]
        left = room - sum(widths[:-1]) - PADDING * len(widths) - PADDING
        return [*widths[:-1], max(left, LEAST)]

    def labels(self) -> list[Text]:
        """Return the headings as they are aligned."""
        return [_right(head) if head in NUMBERS else Text(head) for head in self.heads]


def action_table(actions: Sequence[ActionSnapshot]) -> Table:
    """Return the table of the actions."""
    rows = [
        [
            Text(excerpt(shown(one.info.name))),
            _right(f"{one.active}"),
            _right(f"{one.ended}"),
            _right(f"{one.feedback_rate:.1f}"),
            Text(f"away: {excerpt(message_of(one.away))}", "red")
            if one.away
            else Text(excerpt(one.info.type_name)),
        ]
        for one in actions
    ]
    return Table(["ACTION", "ACTIVE", "ENDED", "FEEDBACK/S", "TYPE"], rows)


class GoalTable:
    """The table of the goals."""

    def __init__(self, details: GoalDetails) -> None:
        self._details = details
        self._meters: dict[GoalKey, ProgressMeter] = {}

    def table(self, goals: Sequence[GoalSnapshot], width: int, now: float) -> Table:
        """Return the table for a screen of that width, at a time in seconds since 1970."""
        self._meters = {goal.key: self._meters.get(goal.key) or ProgressMeter() for goal in goals}
        done = [self._progress(goal) for goal in goals]
        has_bars = any(fraction is not None for fraction in done)
        family, is_wide = Family(goal.info for goal in goals), width >= WIDE
        digits = unambiguous([*(str(goal.info.goal_id) for goal in goals), *family.parents])
        heads = ["ID", "ACTION", "STATUS", *([FAMILY] if family and is_wide else [])]
        heads += [*(["DONE"] if has_bars else []), "AGE", "FEEDBACK", "/S"]
        heads += [*(["CLIENT"] if is_wide else []), "LATEST"]
        bar = next(cells for least, cells in BARS.items() if width >= least)
        rows: list[list[Text]] = []
        for goal, fraction in zip(goals, done, strict=True):
            row = GoalRow(goal.action, goal.info)
            is_active = row.info.status.is_active
            cells = {
                "ID": Text(row.goal_id[:digits]),
                "ACTION": Text(excerpt(shown(row.action))),
                "STATUS": Text(row.status, STYLES.get(row.info.status, "")),
                FAMILY: Text(family.text(row.info, digits)),
                "DONE": Text("") if fraction is None else percent_bar(fraction, bar),
                "AGE": _right(row.age(now)),
                "FEEDBACK": _right(row.feedback),
                "/S": _right(f"{goal.feedback_rate:.1f}" if is_active else ""),
                "CLIENT": Text(row.client),
                "LATEST": self._latest(goal),
            }
            rows.append([cells[head] for head in heads])
        return Table(heads, rows)

    def _progress(self, goal: GoalSnapshot) -> float | None:
        if goal.latest is None or not goal.info.status.is_active:
            return None
        progress = self._meters[goal.key].read(goal.latest.progress)
        return None if progress is None else progress.fraction

    def _latest(self, goal: GoalSnapshot) -> Text:
        """Return the reason or the result of a goal that has ended, or why it runs alone, or else
        the latest feedback.
        """
        end = self._details.end(goal.key).line
        latest = goal.latest.line if goal.latest else ""
        return Text(end or excerpt(goal.info.reason) or latest, no_wrap=True, overflow="ellipsis")


def _right(text: str) -> Text:
    return Text(text, justify="right")
