"""The screen of `fibaction top`, drawn from a `Monitor` a few times a second."""

from __future__ import annotations

import time
from typing import Any, ClassVar, NamedTuple, Self, cast

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import DataTable, Footer, Static

from fibaction.cli.action_names import shown
from fibaction.cli.cancel import reason_of
from fibaction.cli.escape import excerpt
from fibaction.cli.exit_codes import message_of
from fibaction.cli.goal_table import STYLES, GoalRow, unambiguous
from fibaction.cli.progress import on_one_line
from fibaction.cli.yaml_text import as_yaml
from fibaction.exceptions import ActionError
from fibaction.monitor import GoalKey, GoalSnapshot, Monitor, Snapshot

PERIOD = 0.5
"""Seconds between two pictures."""
SETTLING = 2
"""Pictures with goals in which a cursor that was not moved stays at the top: the goals that there
are arrive one by one, and the user has not chosen one of them yet."""
MOST = 200
"""Goals and actions that are shown: each costs time at every picture."""
WIDE = 110
"""Width of a screen with room for the client, too."""
NUMBERS = ("ACTIVE", "ENDED", "FEEDBACK/S", "AGE", "FEEDBACK", "/S")
"""Columns that are aligned to the right."""
PADDING = 2
"""Spaces that a table puts around each cell."""
LEAST = 10
"""Least width of the feedback; a table that is too wide can be scrolled."""


class FeedbackText(NamedTuple):
    """Feedback as text."""

    line: str
    """On one line; large feedback is cut."""
    yaml: str
    """As YAML; large feedback is cut."""

    @classmethod
    def of(cls, feedback: Any) -> Self:
        """Make the texts of a feedback."""
        return cls(on_one_line(feedback), as_yaml(feedback))


class TopScreen(App[None]):
    """Actions above, goals below, and on demand the feedback of one goal."""

    TITLE = "fibaction top"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    #state { height: 1; background: $primary-background; padding: 0 1; }
    #state.away { background: $error; color: $text; }
    DataTable { background: $background; }
    #actions { height: auto; max-height: 30%; margin-bottom: 1; }
    #goals { height: 1fr; }
    #followed { height: 40%; border-top: solid $primary; padding: 0 1; display: none; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("c", "cancel", "Cancel goal"),
        Binding("f,enter", "follow", "Follow goal", key_display="f"),
        Binding("escape", "follow_none", "Follow none", show=False),
        Binding("q,ctrl+c", "quit", "Quit", key_display="q", priority=True),
    ]

    def __init__(self, monitor: Monitor, where: str) -> None:
        """Make the screen of a monitor. `where` is the server, for the first line."""
        super().__init__()
        self._monitor = monitor
        self._where = where
        self._keys: list[GoalKey] = []
        self._followed: GoalSnapshot | None = None
        self._ends: dict[GoalKey, str] = {}  # of the goal that is followed, or was before
        self._settling = SETTLING

    def compose(self) -> ComposeResult:
        yield Static(id="state", markup=False)
        yield DataTable(id="actions", cursor_type="none", show_cursor=False)
        yield DataTable(id="goals", cursor_type="row")
        with VerticalScroll(id="followed"):
            yield Static(id="feedback", markup=False)
        yield Footer()

    def on_mount(self) -> None:
        """Begin to draw."""
        self.query_one("#goals").focus()
        self.set_interval(PERIOD, self.draw)
        self.draw()

    def on_resize(self) -> None:
        """Use the width that there is now."""
        self.draw()

    # Drawing

    def draw(self) -> None:
        """Draw the state of the monitor now."""
        if not self.query("#state"):
            return  # the screen is closing, and its timer has fired once more
        snapshot = self._monitor.snapshot(MOST)
        with self.batch_update():
            self._draw_state(snapshot)
            self._draw_actions(snapshot)
            self._draw_goals(snapshot.goals)
            self._draw_followed()

    def _draw_state(self, snapshot: Snapshot) -> None:
        state = self.query_one("#state", Static)
        away, actions = message_of(snapshot.away), snapshot.actions
        state.set_class(bool(away), "away")
        if away:
            state.update(f"{excerpt(self._where)}  the server is away: {excerpt(away)}")
            return
        active, ended = sum(one.active for one in actions), sum(one.ended for one in actions)
        rate = sum(one.feedback_rate for one in actions)
        counts = f"{active} active, {ended} ended, {rate:.1f} feedback/s"
        state.update(f"{excerpt(self._where)}  {counts}")

    def _draw_actions(self, snapshot: Snapshot) -> None:
        # Actions with active goals come first, if not all of them fit.
        first = sorted(snapshot.actions, key=lambda one: (not one.active, one.info.name))[:MOST]
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
            for one in first
        ]
        self._fill("actions", ["ACTION", "ACTIVE", "ENDED", "FEEDBACK/S", "TYPE"], rows)

    def _draw_goals(self, goals: list[GoalSnapshot]) -> None:
        lines = [(goal, GoalRow(goal.action, goal.info)) for goal in goals]
        now, digits = time.time(), unambiguous(row.goal_id for _, row in lines)
        wide = self.size.width >= WIDE
        heads = ["ID", "ACTION", "STATUS", "AGE", "FEEDBACK", "/S"]
        heads += ["CLIENT", "LATEST"] if wide else ["LATEST"]
        rows = [
            [
                Text(row.goal_id[:digits]),
                Text(excerpt(shown(row.action))),
                Text(row.status, STYLES.get(row.info.status, "")),
                _right(row.age(now)),
                _right(row.feedback),
                _right(f"{goal.feedback_rate:.1f}" if row.info.status.is_active else ""),
                *([Text(row.client)] if wide else []),
                Text(goal.latest.line if goal.latest else "", no_wrap=True, overflow="ellipsis"),
            ]
            for goal, row in lines
        ]
        selected = self._selected()
        self._keys = [goal.key for goal in goals]
        is_at_top = self._table("goals").cursor_row == 0
        self._fill("goals", heads, rows)
        if is_at_top and self._settling:
            self._settling -= bool(lines)
        elif selected is not None and selected in self._keys:
            # The cursor stays at its goal when the goal moves.
            self._table("goals").move_cursor(row=self._keys.index(selected), scroll=False)

    def _fill(self, name: str, heads: list[str], rows: list[list[Text]]) -> None:
        """Draw a table anew. The last column gets the width that is left."""
        table = self._table(name)
        widths = [
            max(map(len, column))
            for column in zip(heads, *[[cell.plain for cell in row] for row in rows], strict=True)
        ]
        left = self.size.width - sum(widths[:-1]) - PADDING * len(widths) - PADDING
        widths[-1] = max(left, LEAST)
        scroll = table.scroll_y
        table.clear(columns=True)
        for head, width in zip(heads, widths, strict=True):
            table.add_column(_right(head) if head in NUMBERS else head, width=width)
        table.add_rows(rows)
        table.scroll_to(y=scroll, animate=False)

    def _table(self, name: str) -> DataTable[Text]:
        return cast("DataTable[Text]", self.query_one(f"#{name}", DataTable))

    def _draw_followed(self) -> None:
        panel = self.query_one("#followed")
        panel.display = self._followed is not None
        if self._followed is not None:
            now = self._monitor.goal(self._followed.key)
            self._followed = goal = now or self._followed
            row = GoalRow(goal.action, goal.info)
            status = row.status if now else "forgotten by the server"
            panel.border_title = Text(  # a `str` would be read as markup
                f"{excerpt(shown(goal.action))} {row.goal_id} {status}"
            )
            latest = "No feedback has come while this screen was open."
            if goal.latest:
                latest = goal.latest.yaml
            end = self._end_of(goal)
            self.query_one("#feedback", Static).update(f"{end}\n\n{latest}" if end else latest)

    def _end_of(self, goal: GoalSnapshot) -> str:
        """Return the reason and the result of a goal; empty until they have come."""
        if not goal.info.status.is_active and goal.key not in self._ends:
            self._ends = {goal.key: ""}
            self.run_worker(self._ask_end(goal.key))
        return self._ends.get(goal.key, "")

    async def _ask_end(self, key: GoalKey) -> None:
        try:
            outcome = await self._monitor.outcome(key)
        except ActionError as exc:
            end = f"The result cannot be had: {excerpt(message_of(exc))}"
        else:
            reason = [f"Reason: {excerpt(outcome.reason)}"] if outcome.reason else []
            result = []
            if outcome.result is not None:
                result = [f"Result:\n{as_yaml(outcome.result, indent=2)}"]
            end = "\n".join([*reason, *result]) or "There is no result."
        self._ends[key] = end
        self.draw()

    # Keys

    def _selected(self) -> GoalKey | None:
        place = self._table("goals").cursor_row
        return self._keys[place] if 0 <= place < len(self._keys) else None

    def on_data_table_row_selected(self) -> None:
        """Follow the goal at the cursor, at Enter or a click."""
        self.action_follow()

    def action_follow(self) -> None:
        """Show the feedback of the goal at the cursor, or hide it if it is shown."""
        key = self._selected()
        if key is None or (self._followed is not None and key == self._followed.key):
            self._followed = None
        else:
            self._followed = self._monitor.goal(key)
        self.draw()

    def action_follow_none(self) -> None:
        """Hide the feedback."""
        self._followed = None
        self.draw()

    def action_cancel(self) -> None:
        """Cancel the goal at the cursor."""
        key = self._selected()
        if key is not None:
            self.run_worker(self._cancel(key))

    async def _cancel(self, key: GoalKey) -> None:
        goal = f"{str(key.goal_id)[:8]} of {excerpt(shown(key.action))}"
        try:
            answer = await self._monitor.cancel(key)
        except ActionError as exc:
            self.notify(excerpt(message_of(exc)), severity="error", markup=False)
            return
        if answer.accepted:
            self.notify(f"Canceling the goal {goal}", markup=False)
        else:
            self.notify(
                f"The goal {goal} is not canceled: {excerpt(reason_of(answer))}",
                severity="warning",
                markup=False,
            )


def _right(text: str) -> Text:
    return Text(text, justify="right")
