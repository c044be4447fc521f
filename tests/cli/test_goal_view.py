"""The goals that `top` lists: filtered, sorted, and with a cursor that stays at its goal."""

from __future__ import annotations

import pytest

from fibaction import ActionInfo, GoalID, GoalInfo, GoalStatus, Parent
from fibaction.cli.output.screen import ORDERS, GoalView
from fibaction.client.events import GoalFeedback
from fibaction.observe.monitor import GoalKey, Monitor


def goal_id(number: int) -> GoalID:
    return GoalID(bytes([number]) * 16)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def a_view(most: int = 10) -> tuple[GoalView, Monitor, Clock]:
    """A view of four goals: 1 and 3 of arm/pick, 2 and 4 of base/drive; the last has ended."""
    clock = Clock()
    monitor = Monitor(clock=clock)
    monitor.on_actions([ActionInfo("base/drive"), ActionInfo("arm/pick")], "")
    for number, action, status, client in (
        (1, "arm/pick", GoalStatus.EXECUTING, "lab"),
        (2, "base/drive", GoalStatus.CANCELING, "lab"),
        (3, "arm/pick", GoalStatus.EXECUTING, "office"),
        (4, "base/drive", GoalStatus.ABORTED, "office"),
    ):
        parent = Parent(goal_id(1), "to the shelf") if number == 4 else None
        info = GoalInfo(goal_id(number), number, status, 0, client, parent=parent)
        monitor.on_event(action, info)
    return GoalView(monitor, most), monitor, clock


def numbers(view: GoalView) -> list[int]:
    return [goal.info.stamp for goal in view.snapshot().goals]


def test_the_orders_follow_each_other_and_begin_again() -> None:
    view, monitor, clock = a_view()
    monitor.on_event("base/drive", GoalFeedback(goal_id(2), 1, None))
    view.snapshot()
    monitor.on_event("base/drive", GoalFeedback(goal_id(2), 9, None))
    clock.now = 1.0
    found = {}
    for _ in ORDERS:
        found[view.order] = numbers(view)
        view.next_order()

    assert found == {
        "newest first": [3, 2, 1, 4],
        "oldest first": [1, 2, 3, 4],
        "by action": [3, 1, 2, 4],
        "by status": [3, 1, 2, 4],
        "by feedback rate": [2, 3, 1, 4],
    }
    assert view.order == "newest first"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", [3, 2, 1, 4]),
        ("  ", [3, 2, 1, 4]),
        ("/ARM", [3, 1]),
        ("drive abort", [4]),
        ("office", [3, 4]),
        ("0303", [3]),
        ("0101", [1, 4]),
        ("shelf", [4]),
        ("nothing", []),
    ],
)
def test_a_goal_must_have_all_words_of_the_filter(words: str, expected: list[int]) -> None:
    view, _, _ = a_view()
    view.filter = words

    assert numbers(view) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("/robot1", ["/robot1/arm/pick", "robot1/drive"]),
        ("/robot1/", ["/robot1/arm/pick", "robot1/drive"]),
        ("/ROBOT1 pick", ["/robot1/arm/pick"]),
        ("/robot1/arm", ["/robot1/arm/pick"]),
        ("/drive", ["robot1/drive", "robot10/drive"]),
        ("/robot", []),
        ("/1", []),
        ("robot1/", ["/robot1/arm/pick", "robot1/drive"]),
        ("robot1", ["/robot1/arm/pick", "robot1/drive", "robot10/drive"]),
        ("/", ["/robot1/arm/pick", "robot1/drive", "robot10/drive"]),
    ],
)
def test_a_word_with_a_slash_in_front_is_whole_parts_of_a_name(
    words: str, expected: list[str]
) -> None:
    monitor = Monitor()
    for number, name in enumerate(("/robot1/arm/pick", "robot1/drive", "robot10/drive"), 1):
        monitor.on_event(name, GoalInfo(goal_id(number), number, GoalStatus.EXECUTING))
    view = GoalView(monitor, 10)
    view.filter = words

    assert sorted(goal.action for goal in view.snapshot().goals) == expected


def test_the_filter_finds_goals_beyond_those_that_are_shown() -> None:
    view, _, _ = a_view(most=1)
    assert numbers(view) == [3]
    view.filter = "drive"

    found = view.snapshot()
    assert [goal.info.stamp for goal in found.goals] == [2]
    assert found.matching == 2
    assert view.keys == [GoalKey("base/drive", goal_id(2))]


def test_the_cursor_stays_at_its_goal_once_the_goals_have_come() -> None:
    view, monitor, _ = a_view()
    for _ in range(2):
        view.snapshot()
        assert view.place_of(view.key_at(2), 0) == 0
    chosen = view.key_at(0)
    monitor.on_event("arm/pick", GoalInfo(goal_id(5), 5, GoalStatus.EXECUTING))
    view.snapshot()

    assert view.place_of(chosen, 0) == 1
    assert view.key_at(1) == chosen
    assert view.place_of(GoalKey("gone", goal_id(9)), 3) == 0
    assert (view.key_at(-1), view.key_at(5)) == (None, None)
