"""The cells of `top`: bars, the latest feedback, and the end of a goal in its place."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction import ActionInfo, GoalID, GoalInfo, GoalStatus, Outcome, Parent
from fibaction.cli.output.goal_details import GoalDetails
from fibaction.cli.output.screen_tables import FeedbackText, GoalTable
from fibaction.client.events import GoalFeedback
from fibaction.observe.monitor import GoalKey, Monitor

ID = GoalID(b"\x11" * 16)


class Ended(Monitor):
    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        return Outcome(GoalStatus.ABORTED, None, "the cup is gone")


def a_monitor(*feedback: Any) -> Monitor:
    """A monitor of a goal that gave this feedback."""
    monitor = Ended(summarize=FeedbackText.of)
    monitor.on_actions([ActionInfo("pick")], "")
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.EXECUTING))
    for number, one in enumerate(feedback, 1):
        monitor.on_event("pick", GoalFeedback(ID, number, one))
    return monitor


def cells(monitor: Monitor, table: GoalTable, width: int = 100) -> dict[str, str]:
    """The cells of the goal by their headings."""
    content = table.table(monitor.snapshot().goals, width, now=0)
    return dict(zip(content.heads, [cell.plain for cell in content.rows[0]], strict=True))


@pytest.mark.parametrize(
    ("feedback", "width", "bar", "rest"),
    [
        ({"progress": 0.45, "step": "grasp"}, 100, "━━━━╸─────  45%", "step: grasp"),
        ({"progress": 0.45, "step": "grasp"}, 80, " 45%", "step: grasp"),
        ({"percent": 100, "left": 0}, 100, "━━━━━━━━━━ 100%", "left: 0"),
        ({"percent": 0}, 100, "──────────   0%", ""),
    ],
)
def test_progress_is_a_bar_and_the_rest_of_the_feedback_is_beside_it(
    feedback: Any, width: int, bar: str, rest: str
) -> None:
    found = cells(a_monitor(feedback), GoalTable(GoalDetails(Monitor())), width)

    assert (found["DONE"], found["LATEST"]) == (bar, rest)


def test_a_progress_that_counted_to_hundred_once_does_so_again() -> None:
    monitor = a_monitor({"progress": 50})
    table = GoalTable(GoalDetails(monitor))
    assert cells(monitor, table)["DONE"].endswith(" 50%")
    monitor.on_event("pick", GoalFeedback(ID, 2, {"progress": 1}))

    assert cells(monitor, table)["DONE"].endswith("  1%")


def test_feedback_without_progress_needs_no_column_for_it() -> None:
    found = cells(a_monitor({"step": "grasp"}), GoalTable(GoalDetails(Monitor())))

    assert "DONE" not in found
    assert found["LATEST"] == "step: grasp"


@pytest.mark.asyncio
async def test_a_goal_that_has_ended_shows_its_end_in_place_of_its_feedback() -> None:
    monitor = a_monitor({"progress": 0.5, "step": "grasp"})
    details = GoalDetails(monitor)
    table = GoalTable(details)
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.ABORTED))
    assert cells(monitor, table)["LATEST"] == "step: grasp"
    await details.ask(details.unknown([GoalKey("pick", ID)], []))

    found = cells(monitor, table)
    assert found["LATEST"] == "the cup is gone"
    assert "DONE" not in found


def test_a_wide_screen_has_a_column_of_steps_if_there_are_some() -> None:
    monitor = a_monitor()
    table = GoalTable(GoalDetails(monitor))
    assert "PARENT, CHILDREN" not in cells(monitor, table, 120)
    parent = Parent(GoalID(b"\x22" * 16), "reach")
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.EXECUTING, parent=parent))

    assert cells(monitor, table, 120)["PARENT, CHILDREN"] == "reach of 22222222"
    assert "PARENT, CHILDREN" not in cells(monitor, table, 80)
