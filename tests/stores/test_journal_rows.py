"""The rows of a journal: what they add up to, and which damage they show."""

from __future__ import annotations

from copy import copy

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fibaction.border.goal_store import StoredGoal
from fibaction.stores.journal_rows import (
    ROW,
    ActionGoals,
    CheckpointRecord,
    DamagedRow,
    KeptGoals,
    Record,
    StartRecord,
    WholeRecord,
    decode_row,
    encode_row,
    ended,
    moved,
)
from fibaction.testing.contract.stores import a_goal, after_end
from fibaction.words.goals import GoalID, Sender
from fibaction.words.statuses import GoalStatus

ACTIONS = ["paint", "drive"]
START = encode_row(1, [StartRecord()])


class Model:
    """The goals that a server has in memory and changes, and the record of each change."""

    def __init__(self) -> None:
        self.goals: dict[str, dict[int, StoredGoal]] = {action: {} for action in ACTIONS}
        self.ends: dict[str, list[int]] = {action: [] for action in ACTIONS}
        self.stamp = 0

    def change(self, action: str, number: int, what: str, data: bytes) -> Record | None:
        """Change a goal, and return the record of that; None if it cannot change so."""
        goals, ends = self.goals[action], self.ends[action]
        goal = goals.get(number)
        if what == "accept" and (goal is None or goal.status.is_terminal):
            self.stamp += 1
            goal_id = GoalID(number.to_bytes(16, "big"))
            meta = {"traceparent": data.hex()} if data else None
            goal = StoredGoal(goal_id, self.stamp, Sender(), data, data, meta=meta)
            goals[number] = goal
            if number in ends:
                ends.remove(number)
            return WholeRecord(action, copy(goal))
        if goal is None or goal.status.is_terminal:
            return None
        if what == "end":
            ends.append(number)
            goal.attempt, goal.lost, goal.feedback_count = (
                goal.attempt + 1,
                goal.lost + 1,
                self.stamp + 1,
            )
            end = {"result": data, "reason": "ü", "keep_until": len(data)}
            if data and goal.goal:
                end |= {"goal": goal.goal, "checkpoint": goal.checkpoint, "meta": goal.meta}
            return ended(action, after_end(goal, **end))
        if what == "checkpoint":
            if data != goal.checkpoint:
                goal.lost = 0
            goal.checkpoint = data
            return CheckpointRecord(action, goal.goal_id, data)
        if what == "cancel":
            goal.status = GoalStatus.CANCELING
        elif what == "begin":
            goal.attempt, goal.lost = goal.attempt + 1, goal.lost + len(data) % 2
            goal.is_running, goal.status = True, GoalStatus.EXECUTING
        else:
            goal.is_running = False
        return moved(action, goal)

    def in_order(self, action: str) -> list[StoredGoal]:
        """Return copies of the goals of an action: by their ends, then by their stamps."""
        goals = self.goals[action]
        active = [goal for goal in goals.values() if goal.status.is_active]
        active.sort(key=lambda goal: goal.stamp)
        return [copy(goal) for goal in [*(goals[number] for number in self.ends[action]), *active]]


changes = st.tuples(
    st.sampled_from(ACTIONS),
    st.integers(1, 3),
    st.sampled_from(["accept", "accept", "begin", "cancel", "checkpoint", "release", "end"]),
    st.binary(max_size=3),
)
journals = st.lists(st.lists(changes, max_size=4), max_size=10)
EACH_CHANGE = [
    [("paint", 1, "accept", b""), ("paint", 1, "begin", b""), ("paint", 1, "checkpoint", b"x")],
    [("paint", 2, "accept", b""), ("paint", 2, "cancel", b""), ("paint", 1, "end", b"y")],
]


def written(
    journal: list[list[tuple[str, int, str, bytes]]], model: Model, first: int
) -> tuple[list[bytes], list[Model]]:
    """Return the rows of a journal, and what is in memory after each of them."""
    rows: list[bytes] = []
    states: list[Model] = []
    for number, batch in enumerate(journal, first):
        model = copy_of(model)
        records = [record for change in batch if (record := model.change(*change)) is not None]
        rows.append(encode_row(number, records))
        states.append(model)
    return rows, states


def copy_of(model: Model) -> Model:
    new = Model()
    new.stamp = model.stamp
    for action in ACTIONS:
        new.goals[action] = {number: copy(goal) for number, goal in model.goals[action].items()}
        new.ends[action] = list(model.ends[action])
    return new


def read(rows: list[bytes], first: int = 1) -> KeptGoals:
    goals = KeptGoals()
    for number, row in enumerate(rows, first):
        goals.read(number, row)
    return goals


def assert_same(goals: KeptGoals, model: Model) -> None:
    for action in ACTIONS:
        assert goals.of(action).in_order() == model.in_order(action)


@given(journals)
@example(EACH_CHANGE)
def test_the_first_rows_add_up_to_the_goals_of_their_time(
    journal: list[list[tuple[str, int, str, bytes]]],
) -> None:
    rows, models = written(journal, Model(), 2)

    for count, model in enumerate([Model(), *models]):
        assert_same(read([START, *rows[:count]]), model)


@given(journals, journals)
def test_goals_that_are_written_down_and_later_rows_add_up_to_all(
    journal: list[list[tuple[str, int, str, bytes]]],
    later: list[list[tuple[str, int, str, bytes]]],
) -> None:
    rows, models = written(journal, Model(), 2)
    [anew] = read([START, *rows]).rows(50)
    model = [Model(), *models][-1]

    later_rows, later_models = written(later, model, 51)

    assert_same(read([anew, *later_rows], 50), [model, *later_models][-1])


@pytest.mark.parametrize("field", ["result", "checkpoint"])
def test_many_goals_are_written_down_in_several_rows(field: str) -> None:
    goals = KeptGoals()
    for number in range(10):
        goals.of("paint").add(WholeRecord("paint", a_goal(number, **{field: b"x" * (ROW // 4)})))

    rows = list(goals.rows(7))

    assert len(rows) == 3
    assert read(rows, 7).of("paint").in_order() == goals.of("paint").in_order()


def test_goals_that_fill_a_row_leave_no_empty_one() -> None:
    goals = KeptGoals()
    goals.of("paint").add(WholeRecord("paint", a_goal(1, result=b"x" * ROW)))

    assert len(list(goals.rows(1))) == 1


def test_ended_goals_are_forgotten_when_their_time_has_passed() -> None:
    goals = ActionGoals()
    for number, until in enumerate([10, 0, 30, 20, 1], 1):
        goals.add(WholeRecord("paint", a_goal(number, status=GoalStatus.ABORTED, keep_until=until)))

    goals.drop_expired(100, 20)

    assert [goal.stamp for goal in goals.in_order()] == [2, 3]


def test_the_oldest_of_too_many_ended_goals_are_forgotten() -> None:
    goals = ActionGoals()
    for number in range(1, 6):
        goals.add(WholeRecord("paint", a_goal(number)))
    for number in (4, 2, 3):
        goals.add(ended("paint", after_end(a_goal(number))))

    goals.drop_expired(2, 0)
    assert [goal.stamp for goal in goals.in_order()] == [2, 3, 1, 5]
    goals.drop_expired(0, 0)
    assert [goal.stamp for goal in goals.in_order()] == [1, 5]


def test_an_end_is_final() -> None:
    goals = ActionGoals()
    goals.add(WholeRecord("paint", a_goal()))
    goals.add(ended("paint", after_end(a_goal())))
    expected = [copy(goal) for goal in goals.in_order()]

    goals.add(ended("paint", after_end(a_goal(), result=b"another")))
    goals.add(moved("paint", a_goal(status=GoalStatus.CANCELING)))

    assert goals.in_order() == expected


def test_half_a_character_in_a_reason_is_written_as_a_question_mark() -> None:
    row = encode_row(1, [ended("paint", after_end(a_goal(), reason="\ud800 ü"))])

    (record,) = decode_row(1, row)

    assert record.reason == "? ü"  # type: ignore[union-attr]  # it is an end


@given(st.integers(0, 10_000), st.integers(1, 255), st.sampled_from([10, 5000]))
def test_a_byte_that_has_changed_is_damage(place: int, change: int, size: int) -> None:
    row = bytearray(encode_row(5, [WholeRecord("paint", a_goal(result=bytes(size)))]))
    row[place % len(row)] ^= change

    with pytest.raises(DamagedRow, match="row 5 is not what was written"):
        decode_row(5, bytes(row))


def test_a_row_under_another_number_is_damage() -> None:
    row = encode_row(5, [StartRecord()])

    with pytest.raises(DamagedRow, match="row 6 is not what was written"):
        decode_row(6, row)


def test_a_row_of_another_format_is_damage() -> None:
    row = encode_row(5, ["what"])  # type: ignore[list-item]  # that is the point

    with pytest.raises(DamagedRow, match="row 5 cannot be read: Expected"):
        decode_row(5, row)


def test_records_have_these_bytes() -> None:
    end = ended("paint", after_end(a_goal(), reason="why", feedback_count=3, keep_until=9))
    records: list[Record] = [
        StartRecord(),
        moved("paint", a_goal()),
        CheckpointRecord("paint", b"id", None),
        end,
    ]

    assert encode_row(1, records).hex() == (
        "a435dd5f9491009802a57061696e74c4100000000000000000000000000000000101c20000009403"
        "a57061696e74c4026964c09c04a57061696e74c41000000000000000000000000000000001040000"
        "c406726573756c74a3776879030509c2"
    )


def test_goals_that_were_given_up_are_kept_whole_and_counted_by_themselves() -> None:
    goals = ActionGoals()
    for number in range(1, 5):
        goal = a_goal(number, checkpoint=b"half")
        goals.add(WholeRecord("paint", copy(goal)))
        whole = {"goal": goal.goal, "checkpoint": goal.checkpoint, "meta": goal.meta}
        goals.add(ended("paint", after_end(goal, **(whole if number < 3 else {}))))

    goals.drop_expired(1, 0)

    given_up, other = goals.in_order()
    assert (given_up.stamp, given_up.is_given_up) == (2, True)
    assert (given_up.goal, given_up.checkpoint) == (b"goal", b"half")
    assert given_up.meta == {"traceparent": "00-2"}
    assert (other.stamp, other.is_given_up) == (4, False)


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_a_row_that_is_missing_is_damage(missing: int) -> None:
    rows = [(1, START)]
    rows += [(number, encode_row(number, [])) for number in (2, 3, 4)]
    del rows[missing]
    goals = KeptGoals()

    with pytest.raises(DamagedRow, match=f"a row before row {missing + 2} is missing"):
        for number, row in rows:
            goals.read(number, row)


def test_a_start_in_the_middle_is_damage() -> None:
    goals = read([START])

    with pytest.raises(DamagedRow, match="a row before row 3 is missing"):
        goals.read(3, encode_row(3, [StartRecord()]))


@pytest.mark.parametrize(("state", "lost"), [(b"1", 2), (b"2", 0)])
def test_a_new_checkpoint_makes_the_lost_attempts_count_no_more(state: bytes, lost: int) -> None:
    goals = KeptGoals()
    goal = StoredGoal(GoalID(bytes(16)), 1, Sender(), b"", b"", lost=2, checkpoint=b"1")
    goals.read(1, encode_row(1, [StartRecord(), WholeRecord("paint", goal)]))
    goals.read(2, encode_row(2, [CheckpointRecord("paint", goal.goal_id, state)]))
    (found,) = goals.of("paint").active.values()
    assert (found.checkpoint, found.lost) == (state, lost)
