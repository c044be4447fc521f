"""The screen of `fibaction top`, drawn from a `Board` a few times a second."""

from __future__ import annotations

import time
from typing import ClassVar, cast

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import DataTable, Footer, Static

from fibaction.cli.app import shown
from fibaction.cli.board import Board, GoalKey, GoalLine
from fibaction.cli.ending import sentence_of
from fibaction.cli.escaping import clean
from fibaction.cli.goal_list import unambiguous
from fibaction.cli.reaching import reason_of
from fibaction.cli.watching import STYLES
from fibaction.exceptions import ActionError

PERIOD = 0.5
"""Seconds between two pictures."""
SETTLING = 2
"""Pictures with goals in which a cursor that was not moved stays at the top: those that there are
come one after another, and nobody has chosen one of them yet."""
MOST = 200
"""Goals that are shown. Nobody scrolls further, and each costs time at every picture."""
WIDE = 110
"""Columns from which on there is room for the client, too."""
NUMBERS = ("ACTIVE", "ENDED", "FEEDBACK/S", "AGE", "FEEDBACK", "/S")
"""Columns that are set to the right."""
PADDING = 2
"""Blanks that a table puts around each cell."""
LEAST = 10
"""Columns of the feedback, at least; a table that is too wide can be scrolled."""


class Screen(App[None]):
    """Actions above, goals below, and the feedback of one of them where that is wanted."""

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

    def __init__(self, board: Board, where: str) -> None:
        """`where` is the server, for the first line."""
        super().__init__()
        self._board = board
        self._where = where
        self._keys: list[GoalKey] = []
        self._followed: GoalLine | None = None
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
        """Draw what is on the board now."""
        if not self.query("#state"):
            return  # the screen is being taken down, and its clock has ticked once more
        self._board.sample()
        with self.batch_update():
            self._draw_state()
            self._draw_actions()
            self._draw_goals()
            self._draw_followed()

    def _draw_state(self) -> None:
        state = self.query_one("#state", Static)
        away = self._board.away
        state.set_class(bool(away), "away")
        if away:
            state.update(f"{clean(self._where)}  the server is away: {clean(away)}")
            return
        actions = self._board.actions.values()
        active, ended = sum(one.active for one in actions), sum(one.ended for one in actions)
        rate = sum(one.rate.per_second for one in actions)
        state.update(f"{clean(self._where)}  {active} active, {ended} ended, {rate:.1f} feedback/s")

    def _draw_actions(self) -> None:
        rows = [
            [
                Text(clean(shown(name))),
                _right(f"{one.active}"),
                _right(f"{one.ended}"),
                _right(f"{one.rate.per_second:.1f}"),
                Text(f"away: {clean(one.away)}", "red")
                if one.away
                else Text(clean(one.info.type_name)),
            ]
            # Where something is going on comes first, if not all of them fit.
            for name, one in sorted(
                self._board.actions.items(), key=lambda item: (not item[1].active, item[0])
            )
        ]
        self._fill("actions", ["ACTION", "ACTIVE", "ENDED", "FEEDBACK/S", "TYPE"], rows)

    def _draw_goals(self) -> None:
        lines = self._board.ordered(MOST)
        now, digits = time.time(), unambiguous(line.row.goal_id for line in lines)
        wide = self.size.width >= WIDE
        heads = ["ID", "ACTION", "STATUS", "AGE", "FEEDBACK", "/S"]
        heads += ["CLIENT", "LATEST"] if wide else ["LATEST"]
        rows = [
            [
                Text(line.row.goal_id[:digits]),
                Text(clean(shown(line.row.action))),
                Text(line.status.name, STYLES.get(line.status, "")),
                _right(line.row.age(now)),
                _right(line.row.feedback),
                _right(f"{line.rate.per_second:.1f}" if line.status.is_active else ""),
                *([Text(line.row.client)] if wide else []),
                Text(line.line, no_wrap=True, overflow="ellipsis"),
            ]
            for line in lines
        ]
        selected = self._selected()
        self._keys = [line.key for line in lines]
        is_at_top = self._table("goals").cursor_row == 0
        self._fill("goals", heads, rows)
        if is_at_top and self._settling:
            self._settling -= bool(lines)
        elif selected is not None and selected in self._keys:
            # The cursor stays at its goal, wherever that is now.
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
        line = self._followed
        panel.display = line is not None
        if line is not None:
            status = (
                line.status.name if line.key in self._board.goals else "forgotten by the server"
            )
            panel.border_title = Text(  # what is only a `str` is obeyed as markup
                f"{clean(shown(line.row.action))} {line.row.goal_id} {status}"
            )
            self.query_one("#feedback", Static).update(
                line.text or "No feedback has come while this screen was open."
            )

    # Keys

    def _selected(self) -> GoalKey | None:
        place = self._table("goals").cursor_row
        return self._keys[place] if 0 <= place < len(self._keys) else None

    def on_data_table_row_selected(self) -> None:
        """Enter, or a click at the goal that the cursor is at."""
        self.action_follow()

    def action_follow(self) -> None:
        """Show the feedback of the goal at the cursor; if it is that already, no more."""
        key = self._selected()
        line = self._board.goals.get(key) if key is not None else None
        self._followed = None if line is self._followed else line
        self.draw()

    def action_follow_none(self) -> None:
        """Show no goal's feedback."""
        self._followed = None
        self.draw()

    def action_cancel(self) -> None:
        """Cancel the goal at the cursor."""
        key = self._selected()
        if key is not None:
            self.run_worker(self._cancel(key))

    async def _cancel(self, key: GoalKey) -> None:
        goal = f"{str(key.goal_id)[:8]} of {clean(shown(key.action))}"
        try:
            answer = await self._board.cancel(key)
        except ActionError as exc:
            self.notify(clean(sentence_of(exc)), severity="error", markup=False)
            return
        if answer.accepted:
            self.notify(f"Canceling the goal {goal}", markup=False)
        else:
            self.notify(
                f"The goal {goal} is not canceled: {clean(reason_of(answer))}",
                severity="warning",
                markup=False,
            )


def _right(text: str) -> Text:
    return Text(text, justify="right")
