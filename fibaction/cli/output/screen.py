"""The screen of `fibaction top`, drawn from a `Monitor` a few times a second.

It lists the goals that match a filter, in an order: `GoalView`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, cast

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import DataTable, Footer, Input, Static

from fibaction.cli.arguments.names import shown
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_details import DetailQuestion, GoalDetails
from fibaction.cli.output.goal_table import GoalRow, family_of, step_of
from fibaction.cli.output.screen_tables import GoalTable, Table, action_table
from fibaction.cli.process.exit_codes import message_of, reason_of
from fibaction.observe.monitor import GoalKey, GoalSnapshot, Monitor, Snapshot, newest_active_first
from fibaction.words.errors import ActionError

SETTLING = 2
"""Pictures with goals in which a cursor that was not moved stays at the top: the goals that there
are arrive one by one, and the user has not chosen one of them yet."""


ORDERS: Mapping[str, Callable[[GoalSnapshot], tuple[Any, ...]]] = {
    "newest first": lambda goal: newest_active_first(goal.info),
    "oldest first": lambda goal: (not goal.info.status.is_active, goal.info.stamp),
    "by action": lambda goal: (goal.action, newest_active_first(goal.info)),
    "by status": lambda goal: (goal.info.status, -goal.info.stamp),
    "by feedback rate": lambda goal: (-goal.feedback_rate, newest_active_first(goal.info)),
}
"""The orders of goals and their names, in the order in which the user meets them."""


class GoalView:
    """A part of a monitor's goals, as the user has asked for it."""

    def __init__(self, monitor: Monitor, most: int) -> None:
        """Make a view of at most so many goals."""
        self._monitor = monitor
        self._most = most
        self._orders: Sequence[str] = tuple(ORDERS)
        self._settling = SETTLING
        self.filter = ""
        """The words that a goal must have, in its action, ID, status, client, step or parent's ID.
        One that begins with `/` is one or several whole parts of the action's name."""
        self.keys: list[GoalKey] = []
        """The goals of the last snapshot, from above."""

    @property
    def order(self) -> str:
        """The name of the order."""
        return self._orders[0]

    def next_order(self) -> None:
        """Take the next order."""
        self._orders = (*self._orders[1:], self._orders[0])

    def snapshot(self) -> Snapshot:
        """Return the state of the monitor now, with the goals of this view."""
        words = self.filter.lower().split()

        def matches(goal: GoalSnapshot) -> bool:
            if not words:
                return True
            row = GoalRow(goal.action, goal.info)
            action = shown(row.action).lower()
            step = step_of(row.info.parent) if row.info.parent else ""
            text = f"{row.goal_id} {action} {row.status} {row.client} {step}".lower()
            return all(
                _has_parts(action, word) if word.startswith("/") else word in text for word in words
            )

        found = self._monitor.snapshot(self._most, matches=matches, order=ORDERS[self.order])
        self.keys = [goal.key for goal in found.goals]
        return found

    def key_at(self, place: int) -> GoalKey | None:
        """Return the goal at a place from above; None if there is none."""
        return self.keys[place] if 0 <= place < len(self.keys) else None

    def place_of(self, selected: GoalKey | None, before: int) -> int:
        """Return the place of the cursor, which was on a goal and at a place before.

        It stays on its goal when the goal moves. Without that goal it is at the top.
        """
        if before == 0 and self._settling:
            self._settling -= bool(self.keys)
            return 0
        if selected is None or selected not in self.keys:
            return 0
        return self.keys.index(selected)


def _has_parts(name: str, parts: str) -> bool:
    """Return whether a name has these parts, one after another: `/robot1` is not `/robot10`."""
    return f"{parts.rstrip('/')}/" in f"{name}/"


PERIOD = 0.5
"""Seconds between two pictures."""
MOST_SHOWN = 200
"""Goals and actions that are shown: each costs time at every picture."""


class TopScreen(App[None]):
    """Actions above, goals below, and on demand the details of one goal."""

    TITLE = "fibaction top"
    ENABLE_COMMAND_PALETTE = False
    CSS = """
    #state { height: 1; background: $primary-background; padding: 0 1; }
    #state.away { background: $error; color: $text; }
    DataTable { background: $background; }
    #actions { height: auto; max-height: 30%; margin-bottom: 1; }
    #goals { height: 1fr; }
    #followed { height: 40%; border-top: solid $primary; padding: 0 1; display: none; }
    #filter { height: 1; border: none; padding: 0 1; display: none; }
    #question { height: 1; background: $warning; color: $text; padding: 0 1; display: none; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "cancel_it", "Yes, cancel it"),
        Binding("n", "leave_it", "No"),
        Binding("c", "cancel", "Cancel goal"),
        Binding("f,enter", "follow", "Follow goal", key_display="f"),
        Binding("slash", "filter", "Filter", key_display="/"),
        Binding("s", "sort", "Sort"),
        Binding("q", "quit", "Quit"),
        Binding("escape", "step_back", "Back", show=False),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
    ]

    def __init__(self, monitor: Monitor, where: str) -> None:
        """Make the screen of a monitor. `where` is the server, for the first line."""
        super().__init__()
        self._monitor = monitor
        self._where = where
        self._view = GoalView(monitor, MOST_SHOWN)
        self._details = GoalDetails(monitor)
        self._goal_table = GoalTable(self._details)
        self._followed: GoalSnapshot | None = None
        self._to_cancel: GoalKey | None = None

    def compose(self) -> ComposeResult:
        yield Static(id="state", markup=False)
        yield DataTable(id="actions", cursor_type="none", show_cursor=False)
        yield DataTable(id="goals", cursor_type="row")
        with VerticalScroll(id="followed"):
            yield Static(id="details", markup=False)
        yield Static(id="question", markup=False)
        yield Input(id="filter", placeholder="words of an action, ID, status or client")
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
        cursor = self._goals().cursor_row
        selected = self._view.key_at(cursor)
        snapshot = self._view.snapshot()
        with self.batch_update():
            self._draw_state(snapshot)
            # Actions with active goals come first, if not all of them fit.
            actions = sorted(snapshot.actions, key=lambda one: (not one.active, one.info.name))
            self._fill("actions", action_table(actions[:MOST_SHOWN]))
            width = self.size.width
            self._fill("goals", self._goal_table.table(snapshot.goals, width, time.time()))
            self._goals().move_cursor(row=self._view.place_of(selected, cursor), scroll=False)
            self._draw_followed()
            self._draw_question()
        self._ask_details(snapshot.goals)

    def _draw_state(self, snapshot: Snapshot) -> None:
        state = self.query_one("#state", Static)
        away, actions = message_of(snapshot.away), snapshot.actions
        state.set_class(bool(away), "away")
        if away:
            state.update(f"{excerpt(self._where)}  the server is away: {excerpt(away)}")
            return
        active, ended = sum(one.active for one in actions), sum(one.ended for one in actions)
        rate = sum(one.feedback_rate for one in actions)
        parts = [excerpt(self._where), f"{active} active, {ended} ended, {rate:.1f} feedback/s"]
        parts.append(self._view.order)
        if self._view.filter:
            matching = f"{snapshot.matching} of {active + ended}"
            parts.append(f"{matching} with “{excerpt(self._view.filter)}”")
        state.update("  ".join(parts))

    def _fill(self, name: str, content: Table) -> None:
        """Draw a table anew."""
        table = self._table(name)
        scroll = table.scroll_y
        table.clear(columns=True)
        widths = content.widths(self.size.width)
        for label, width in zip(content.labels(), widths, strict=True):
            table.add_column(label, width=width)
        table.add_rows(content.rows)
        table.scroll_to(y=scroll, animate=False)

    def _table(self, name: str) -> DataTable[Text]:
        return cast("DataTable[Text]", self.query_one(f"#{name}", DataTable))

    def _goals(self) -> DataTable[Text]:
        return self._table("goals")

    def _draw_followed(self) -> None:
        panel = self.query_one("#followed")
        panel.display = self._followed is not None
        if self._followed is None:
            return
        now = self._monitor.goal(self._followed.key)
        self._followed = goal = now or self._followed
        row = GoalRow(goal.action, goal.info)
        status = row.status if now else "forgotten by the server"
        panel.border_title = Text(  # a `str` would be read as markup
            f"{excerpt(shown(goal.action))} {row.goal_id} {status}"
        )
        latest = "No feedback has come while this screen was open."
        if goal.latest:
            latest = f"Feedback:\n{goal.latest.yaml}"
        parts = [self._details.end(goal.key).text, self._details.request(goal.key).text, latest]
        parts.append(family_of(self._monitor, goal))
        self.query_one("#details", Static).update("\n\n".join(filter(None, parts)))

    def _draw_question(self) -> None:
        question = self.query_one("#question", Static)
        question.display = self._to_cancel is not None
        if self._to_cancel is not None:
            question.update(f"Cancel the goal {_name_of(self._to_cancel)}?")

    def _ask_details(self, goals: list[GoalSnapshot]) -> None:
        """Ask for the ends of the goals in sight, and for the goal that is followed itself."""
        table = self._goals()
        first = int(table.scroll_y)
        seen = goals[first : first + max(table.size.height, 1)]
        followed = [self._followed] if self._followed else []
        self._details.keep([one.key for one in (*goals, *followed)])
        ended = [one.key for one in (*seen, *followed) if not one.info.status.is_active]
        active = [one.key for one in followed if one.info.status.is_active]
        questions = self._details.unknown(dict.fromkeys(ended), active)
        if questions:
            self.run_worker(self._ask(questions))

    async def _ask(self, questions: list[DetailQuestion]) -> None:
        await self._details.ask(questions)
        self.draw()

    # Keys

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool:
        """Allow the answers to a question while there is one, and the other keys while not."""
        is_answer = action in ("cancel_it", "leave_it")
        return action in ("step_back", "quit") or is_answer == (self._to_cancel is not None)

    def on_data_table_row_selected(self) -> None:
        """Follow the goal at the cursor, at Enter or a click."""
        self.action_follow()

    def action_follow(self) -> None:
        """Show the details of the goal at the cursor, or hide them if they are shown."""
        key = self._selected()
        if key is None or (self._followed is not None and key == self._followed.key):
            self._followed = None
        else:
            self._followed = self._monitor.goal(key)
        self.draw()

    def action_step_back(self) -> None:
        """Leave the question, or else the filter, or else the details."""
        if self._to_cancel is not None:
            self._ask_to_cancel(None)
        elif self._view.filter or self.query_one("#filter").display:
            self.query_one("#filter", Input).value = ""
            self._end_filter()
        else:
            self._followed = None
            self.draw()

    def action_sort(self) -> None:
        """Sort the goals in the next order."""
        self._view.next_order()
        self.draw()

    def action_filter(self) -> None:
        """Let the user type the words that a goal must have."""
        line = self.query_one("#filter", Input)
        line.display = True
        line.focus()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Show the goals that match what has been typed so far."""
        self._view.filter = event.value
        self.draw()

    def on_input_submitted(self) -> None:
        """Keep the filter, and go back to the goals."""
        self._end_filter()

    def _end_filter(self) -> None:
        self.query_one("#filter").display = False
        self._goals().focus()

    def action_cancel(self) -> None:
        """Ask before the goal at the cursor is canceled."""
        self._ask_to_cancel(self._selected())

    def action_leave_it(self) -> None:
        """Leave the goal as it is."""
        self._ask_to_cancel(None)

    def action_cancel_it(self) -> None:
        """Cancel the goal of the question."""
        assert self._to_cancel is not None  # `check_action` allows it then
        self.run_worker(self._cancel(self._to_cancel))
        self._ask_to_cancel(None)

    def _ask_to_cancel(self, key: GoalKey | None) -> None:
        self._to_cancel = key
        self.refresh_bindings()
        self.draw()

    async def _cancel(self, key: GoalKey) -> None:
        try:
            answer = await self._monitor.cancel(key)
        except ActionError as exc:
            self.notify(excerpt(message_of(exc)), severity="error", markup=False)
            return
        if answer.accepted:
            self.notify(f"Canceling the goal {_name_of(key)}", markup=False)
        else:
            self.notify(
                f"The goal {_name_of(key)} is not canceled: {excerpt(reason_of(answer))}",
                severity="warning",
                markup=False,
            )

    def _selected(self) -> GoalKey | None:
        return self._view.key_at(self._goals().cursor_row)


def _name_of(key: GoalKey) -> str:
    return f"{str(key.goal_id)[:8]} of {excerpt(shown(key.action))}"
