"""What is on the screen of `top`: the goals that are listed, their cells, and their details."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import ActionInfo, ConnectionLost, GoalID, GoalInfo, GoalStatus, Outcome, Parent
from fibaction.cli.output.goal_details import Detail, GoalDetails
from fibaction.cli.output.screen import ORDERS, GoalView
from fibaction.cli.output.screen_tables import FeedbackText, GoalTable
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


ID = GoalID(b"\x11" * 16)


class Ended(Monitor):
    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        return Outcome(GoalStatus.ABORTED, None, "the cup is gone")


def a_monitor_of(*feedback: Any) -> Monitor:
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
    found = cells(a_monitor_of(feedback), GoalTable(GoalDetails(Monitor())), width)

    assert (found["DONE"], found["LATEST"]) == (bar, rest)


def test_a_progress_that_counted_to_hundred_once_does_so_again() -> None:
    monitor = a_monitor_of({"progress": 50})
    table = GoalTable(GoalDetails(monitor))
    assert cells(monitor, table)["DONE"].endswith(" 50%")
    monitor.on_event("pick", GoalFeedback(ID, 2, {"progress": 1}))

    assert cells(monitor, table)["DONE"].endswith("  1%")


def test_feedback_without_progress_needs_no_column_for_it() -> None:
    found = cells(a_monitor_of({"step": "grasp"}), GoalTable(GoalDetails(Monitor())))

    assert "DONE" not in found
    assert found["LATEST"] == "step: grasp"


@pytest.mark.asyncio
async def test_a_goal_that_has_ended_shows_its_end_in_place_of_its_feedback() -> None:
    monitor = a_monitor_of({"progress": 0.5, "step": "grasp"})
    details = GoalDetails(monitor)
    table = GoalTable(details)
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.ABORTED))
    assert cells(monitor, table)["LATEST"] == "step: grasp"
    await details.ask(details.unknown([GoalKey("pick", ID)], []))

    found = cells(monitor, table)
    assert found["LATEST"] == "the cup is gone"
    assert "DONE" not in found


def test_a_wide_screen_has_a_column_of_steps_if_there_are_some() -> None:
    monitor = a_monitor_of()
    table = GoalTable(GoalDetails(monitor))
    assert "PARENT, CHILDREN" not in cells(monitor, table, 120)
    parent = Parent(GoalID(b"\x22" * 16), "reach")
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.EXECUTING, parent=parent))

    assert cells(monitor, table, 120)["PARENT, CHILDREN"] == "reach of 22222222"
    assert "PARENT, CHILDREN" not in cells(monitor, table, 80)


ONE, TWO = (GoalKey("pick", GoalID(bytes([number]) * 16)) for number in (1, 2))


class Answering(Monitor):
    """A monitor with fixed answers; an exception is raised, and None never comes."""

    def __init__(self, outcome: Any = None, request: Any = None) -> None:
        super().__init__()
        self.answers = {"outcome": outcome, "request": request}
        self.asked: list[GoalKey] = []

    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        answer: Outcome[Any] = await self._answer(key, "outcome")
        return answer

    async def request(self, key: GoalKey) -> Any:
        return await self._answer(key, "request")

    async def _answer(self, key: GoalKey, name: str) -> Any:
        self.asked.append(key)
        answer = self.answers[name]
        if isinstance(answer, Exception):
            raise answer
        if answer is Ellipsis:
            await anyio.sleep_forever()
        return answer


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (
            Outcome(GoalStatus.ABORTED, {"meters": 2}, "stuck\x1b"),
            Detail("stuck\\x1b", "Reason: stuck\\x1b\nResult:\n  meters: 2"),
        ),
        (Outcome(GoalStatus.SUCCEEDED, 0), Detail("0", "Result:\n  0")),
        (Outcome(GoalStatus.CANCELED), Detail("", "There is no result.")),
        (ConnectionLost("it is dead"), Detail("", "The result cannot be had: it is dead")),
        (..., Detail("", "The result cannot be had: there was no answer within 0.01 s")),
    ],
)
async def test_the_end_of_a_goal_is_its_reason_and_its_result(
    outcome: Any, expected: Detail
) -> None:
    timeout = 0.01 if outcome is Ellipsis else 10
    details = GoalDetails(Answering(outcome), timeout)
    await details.ask(details.unknown([ONE], []))

    assert details.end(ONE) == expected
    assert details.end(TWO) == Detail("", "")


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("request_", "text"),
    [
        ({"order": 3}, "Goal:\n  order: 3"),
        (None, ""),
        (ConnectionLost("it is dead"), "The goal cannot be had: it is dead"),
    ],
)
async def test_a_goal_is_shown_as_it_was_sent(request_: Any, text: str) -> None:
    details = GoalDetails(Answering(request=request_))
    await details.ask(details.unknown([], [ONE]))

    assert details.request(ONE).text == text


@pytest.mark.asyncio
async def test_each_detail_is_asked_for_once_until_its_goal_is_forgotten() -> None:
    monitor = Answering(Outcome(GoalStatus.CANCELED), 1)
    details = GoalDetails(monitor)
    questions = details.unknown([ONE, TWO], [TWO])
    assert details.unknown([ONE, TWO], [TWO]) == []
    await details.ask(questions)
    details.keep([TWO])
    assert [question.key for question in details.unknown([ONE, TWO], [TWO])] == [ONE]

    assert sorted(monitor.asked) == [ONE, TWO, TWO]
