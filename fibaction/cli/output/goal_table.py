"""Goals in columns, with their parents and children, for `goals` and `top`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import msgspec

from fibaction.cli.arguments.names import shown
from fibaction.cli.output.escape import excerpt, printable
from fibaction.cli.output.lines import as_json
from fibaction.observe.monitor import newest_active_first
from fibaction.words.goals import GoalID, GoalInfo, Outcome, Parent
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from fibaction.observe.monitor import GoalSnapshot, Monitor


class Family:
    """The parents and the children of the goals of a list; those elsewhere are not known."""

    def __init__(self, infos: Iterable[GoalInfo]) -> None:
        self._children: dict[GoalID, list[GoalID]] = {}
        for info in infos:
            if info.parent is not None:
                self._children.setdefault(info.parent.goal_id, []).append(info.goal_id)

    def __bool__(self) -> bool:
        return bool(self._children)

    @property
    def parents(self) -> Iterator[str]:
        """The IDs of all parents, as text; some may be of goals that are not listed."""
        return map(str, self._children)

    def text(self, info: GoalInfo, digits: int) -> str:
        """Return the step that a goal is, and the number of its children, with IDs cut to so many
        digits.
        """
        parts = [step_of(info.parent, digits)] if info.parent else []
        if count := len(self.children(info.goal_id)):
            parts.append("1 child" if count == 1 else f"{count} children")
        return ", ".join(parts)

    def children(self, goal_id: GoalID) -> list[str]:
        """Return the IDs of the children of a goal, as text."""
        return [str(child) for child in self._children.get(goal_id, ())]


def step_of(parent: Parent, digits: int = 32) -> str:
    """Return the name of a step and its goal; `step of` without a name."""
    return f"{excerpt(parent.step) or 'step'} of {str(parent.goal_id)[:digits]}"


def parent_json(parent: Parent | None) -> dict[str, str] | None:
    """Return the parent of a goal for a program."""
    return None if parent is None else {"goal_id": str(parent.goal_id), "step": parent.step}


def family_of(monitor: Monitor, goal: GoalSnapshot) -> str:
    """Return the parent and the children of a goal with their statuses; empty if it has none."""
    lines: list[str] = []
    if goal.info.parent is not None:
        parent = monitor.find(goal.info.parent.goal_id)
        state = "of another server, or forgotten" if parent is None else _state_of(parent)
        lines.append(f"Parent: {step_of(goal.info.parent)}, {state}")
    children = monitor.children(goal.info.goal_id)
    lines += ["Children:"] if children else []
    for child in children:
        step = excerpt(child.info.parent.step) if child.info.parent else ""
        lines.append(f"  {step or 'step'}: {child.info.goal_id}, {_state_of(child)}")
    return "\n".join(lines)


def _state_of(goal: GoalSnapshot) -> str:
    return f"{excerpt(shown(goal.action))} {goal.info.status.name}"


SHORT = 8
"""Digits of a goal's ID where there is no room for all 32; more if so many do not tell the goals
apart."""
GAP = "  "
LEAST_END = 14
"""Least room for the reason or the result of a goal; with less they are left out."""
GOOD_END = 30
"""Room for the reason or the result that is worth shorter IDs."""
NO_WORKER = "no worker"
"""The status of an active goal that no living worker of a fleet has."""
LONGEST_END = 100
"""Characters of a reason or a result where the width is not limited."""

ACTION = "ACTION"
FAMILY = "PARENT, CHILDREN"
"""Heading of the steps and the numbers of children, which is there if a goal has some."""

STYLES = {
    GoalStatus.ACCEPTED: "cyan",
    GoalStatus.EXECUTING: "bold green",
    GoalStatus.CANCELING: "bold yellow",
    GoalStatus.SUCCEEDED: "green",
    GoalStatus.CANCELED: "yellow",
    GoalStatus.ABORTED: "red",
}
"""The style of each status on a terminal."""


class GoalRow(msgspec.Struct, frozen=True):
    """A goal of an action, with the texts of its cells."""

    action: str
    info: GoalInfo
    outcome: Outcome[Any] | None = None
    """The outcome of a goal that has ended; None if it is not known."""
    end: str = ""
    """The reason or the result on one line."""

    @property
    def goal_id(self) -> str:
        """The goal's ID as text."""
        return str(self.info.goal_id)

    @property
    def status(self) -> str:
        """The goal's status, its place in the queue if it waits, or that it has no worker."""
        info = self.info
        if not info.has_worker:
            return NO_WORKER
        if info.place:
            return f"waits, {ordinal(info.place)} of {info.queue_length}"
        return info.status.name

    @property
    def feedback(self) -> str:
        """The number of feedback messages; `-` over ROS, which counts none and names no clients."""
        count, client = self.info.feedback_count, self.info.client
        return str(count) if count or client else "-"

    @property
    def client(self) -> str:
        """The client that sent it."""
        return excerpt(self.info.client) or "-"

    def age(self, now: float) -> str:
        """Return the time since it was accepted, if the clocks agree."""
        return duration(now - self.info.stamp / 1e9)

    def json(self) -> dict[str, Any]:
        """Return the row for a program."""
        info, outcome = self.info, self.outcome
        end = {} if outcome is None else {"reason": outcome.reason, "result": outcome.result}
        return {
            "action": self.action,
            "goal_id": self.goal_id,
            "stamp": info.stamp,
            "status": info.status.name,
            "feedback_count": info.feedback_count,
            "client": info.client,
            "place": info.place,
            "queue_length": info.queue_length,
            "attempt": info.attempt,
            "has_worker": info.has_worker,
            "worker": info.worker,
            "parent": parent_json(info.parent),
            "labels": info.labels,
            "began_at": info.began_at,
            "ended_at": info.ended_at,
            "waited": info.waited,
            "ran": info.ran,
            "reason": info.reason,
            **end,
        }


CSV_COLUMNS = (
    *("action", "goal_id", "status", "accepted_at", "began_at", "ended_at", "waited", "ran"),
    *("attempt", "feedback_count", "client", "parent", "step", "reason", "result", "labels"),
    "worker",
)
"""The columns of a list of goals as CSV."""


def csv_cells(row: GoalRow) -> list[str]:
    """Return the cells of a row of CSV: times in ISO 8601, spans in seconds, the result and the
    labels in JSON; what is not known is empty.
    """
    info, outcome = row.info, row.outcome
    parent, step = (str(info.parent.goal_id), info.parent.step) if info.parent else ("", "")
    reason, result = (info.reason, None) if outcome is None else (outcome.reason, outcome.result)
    return [
        csv_text(row.action),
        row.goal_id,
        info.status.name,
        *map(iso_time, (info.stamp, info.began_at, info.ended_at)),
        *map(_seconds, (info.waited, info.ran)),
        str(info.attempt),
        str(info.feedback_count),
        csv_text(info.client),
        parent,
        csv_text(step),
        csv_text(reason),
        "" if result is None else as_json(result),
        as_json(info.labels) if info.labels else "",
        csv_text(info.worker),
    ]


def iso_time(time_ns: int | None) -> str:
    """Return a time as text; empty if there is none."""
    if time_ns is None:
        return ""
    when = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{when:%Y-%m-%dT%H:%M:%S}.{time_ns // 1000 % 10**6:06}Z"


def _seconds(span: float | None) -> str:
    return "" if span is None else f"{span:.6f}"


def csv_text(text: str) -> str:
    """Return text of others for a cell, on one line. An apostrophe before it keeps a spreadsheet
    from taking it for a formula.
    """
    text = printable(text)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def ordinal(number: int) -> str:
    """Return a number as a place: 1st, 2nd, 3rd, 4th, 11th, 21st."""
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{'th' if number % 100 in (11, 12, 13) else ending}"


def duration(seconds: float) -> str:
    """Return a time that has passed, with the precision that a person needs."""
    if seconds < 10:
        return f"{max(seconds, 0):.1f} s"
    for unit, size, most in (("s", 1, 120), ("min", 60, 120), ("h", 3600, 48)):
        if seconds < size * most:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} d"


def in_columns(
    rows: Sequence[GoalRow], *, actions: bool, width: int | None = None, now: float | None = None
) -> list[str]:
    """Return the rows as lines below a line of headings. With `width`, they are made to fit."""
    now = time.time() if now is None else now
    digits, family = 32, Family(row.info for row in rows)
    ends = [row.end or excerpt(row.info.reason) for row in rows]
    table = _cells(rows, family, digits, now, actions=actions)
    needed = _width(table) + (GOOD_END if any(ends) else 0)
    if width is not None and needed > width:
        digits = unambiguous([*(row.goal_id for row in rows), *family.parents])
        table = _cells(rows, family, digits, now, actions=actions)
    spare = None if width is None else width - _width(table)
    if spare is not None and spare < 0:
        table = _narrowed(table, -spare)
    return _with_ends(aligned(table), ends, width)


def _with_ends(lines: list[str], ends: list[str], width: int | None) -> list[str]:
    """Return the lines with the ends of the goals behind them, as far as there is room."""
    longest = max(map(len, lines))
    room = LONGEST_END if width is None else width - longest - len(GAP)
    if not any(ends) or room < LEAST_END:
        return lines
    cut = (end if len(end) <= room else f"{end[: room - 1]}…" for end in ends)
    table = zip(lines, ["REASON, RESULT"[:room], *cut], strict=True)
    return [f"{line.ljust(longest)}{GAP}{end}".rstrip() for line, end in table]


def aligned(table: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines, with the cells of each column below each other."""
    widths = _widths(table)
    return [_joined(cells, widths) for cells in table]


def in_color(rows: Sequence[GoalRow], lines: Sequence[str]) -> list[Text]:
    """Return the lines of `in_columns` for a terminal."""
    from rich.text import Text

    heading, *texts = lines
    colored = [Text(heading, "bold")]
    for row, text in zip(rows, texts, strict=True):
        status = row.info.status
        line = Text(text, "" if status.is_active else "dim")
        line.highlight_regex(rf"(?<= ){row.status}(?= )", STYLES.get(status, ""))
        colored.append(line)
    return colored


def picture(screen: Console, rows: Sequence[GoalRow], away: str, *, actions: bool) -> Text:
    """Return the list as it fits on the screen: active goals first, the newest first among each."""
    from rich.text import Text

    fitting = max(screen.height - 3, 1)
    seen = sorted(rows, key=lambda row: newest_active_first(row.info))[:fitting]
    lines = in_color(seen, in_columns(seen, actions=actions, width=screen.width - 1))
    active = sum(row.info.status.is_active for row in rows)
    state = f"{active} active, {len(rows) - active} ended"
    if len(seen) < len(rows):
        state += f"; {len(rows) - len(seen)} not shown"
    if away:
        lines.append(Text(f"The server is away: {excerpt(away)}", "bold red"))
    else:
        lines.append(Text(state, "dim"))
    return Text("\n", no_wrap=True, overflow="ellipsis").join(lines)


def unambiguous(goal_ids: Iterable[str]) -> int:
    """Return how many digits tell these IDs apart, at least `SHORT`."""
    ids = sorted(set(goal_ids))
    digits = SHORT
    for one, next_one in pairwise(ids):
        while one[:digits] == next_one[:digits]:
            digits += 1
    return digits


def _cells(
    rows: Iterable[GoalRow], family: Family, digits: int, now: float, *, actions: bool
) -> list[list[str]]:
    heads = ["ID", ACTION, "STATUS", FAMILY, "AGE", "FEEDBACK", "CLIENT"]
    table = [heads]
    for row in rows:
        action, kin = excerpt(shown(row.action)), family.text(row.info, digits)
        cells = [row.goal_id[:digits], action, row.status, kin, row.age(now)]
        table.append([*cells, row.feedback, row.client])
    is_there = {ACTION: actions, FAMILY: bool(family)}
    kept = [column for column, head in enumerate(heads) if is_there.get(head, True)]
    return [[cells[column] for column in kept] for cells in table]


def _widths(table: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*table, strict=True)]


def _width(table: Sequence[Sequence[str]]) -> int:
    widths = _widths(table)
    return sum(widths) + len(GAP) * (len(widths) - 1)


def _narrowed(table: list[list[str]], excess: int) -> list[list[str]]:
    """Return the table, with the clients, the steps and the actions shortened by the excess."""
    widths = _widths(table)
    narrowed = [list(cells) for cells in table]
    # The client first: people look for the name of the action.
    for head in ("CLIENT", FAMILY, ACTION):
        if head not in table[0]:
            continue
        column = table[0].index(head)
        room = max(widths[column] - excess, SHORT)
        excess -= widths[column] - room
        for cells in narrowed:
            if len(cells[column]) > room:
                cells[column] = cells[column][: room - 1] + "…"
    return narrowed


def _joined(cells: Sequence[str], widths: Sequence[int]) -> str:
    # Ages and counts to the right.
    last = len(cells) - 1
    padded = (
        cell.rjust(width) if last - 2 <= column < last else cell.ljust(width)
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return GAP.join(padded).rstrip()
