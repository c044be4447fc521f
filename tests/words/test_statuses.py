from __future__ import annotations

import msgspec
import pydantic
import pytest
from hypothesis import settings, strategies
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from fibaction.schema.payload import GoalCodec
from fibaction.types.action import Action
from fibaction.words.errors import InvalidTransition
from fibaction.words.statuses import INITIAL, TRANSITIONS, GoalEvent, GoalStatus, transition

# Written down from `rcl_action/src/rcl_action/goal_state_machine.c`, not from the code under test.
EDGES = """
    ACCEPTED   EXECUTE      EXECUTING
    ACCEPTED   CANCEL_GOAL  CANCELING
    EXECUTING  CANCEL_GOAL  CANCELING
    EXECUTING  SUCCEED      SUCCEEDED
    EXECUTING  ABORT        ABORTED
    CANCELING  SUCCEED      SUCCEEDED
    CANCELING  ABORT        ABORTED
    CANCELING  CANCELED     CANCELED
"""
FOLLOWERS = {
    (before, event): after
    for before, event, after in (line.split() for line in EDGES.strip().splitlines())
}


@pytest.mark.promise("STATUS-3")
@pytest.mark.parametrize("event", list(GoalEvent), ids=lambda event: event.name)
@pytest.mark.parametrize("status", list(GoalStatus), ids=lambda status: status.name)
def test_a_status_follows_an_event_exactly_if_ros_says_so(
    status: GoalStatus, event: GoalEvent
) -> None:
    after = FOLLOWERS.get((status.name, event.name))
    if after is None:
        with pytest.raises(InvalidTransition) as caught:
            transition(status, event)
        assert (caught.value.status, caught.value.event) == (status, event)
        assert caught.value.__suppress_context__
    else:
        assert transition(status, event) is GoalStatus[after]


@pytest.mark.promise("STATUS-3")
def test_there_are_eight_legal_edges() -> None:
    assert len(TRANSITIONS) == len(FOLLOWERS) == 8


def test_statuses_and_events_print_their_names() -> None:
    assert f"{GoalStatus.ACCEPTED} {GoalEvent.EXECUTE:>8}" == "ACCEPTED  EXECUTE"
    assert str(GoalStatus.CANCELED) == "CANCELED"


def test_a_status_prints_its_number_where_a_number_is_asked_for() -> None:
    assert f"{GoalStatus.CANCELED:d} {GoalStatus.CANCELED:03d} {GoalStatus.CANCELED:x}" == "5 005 5"


@pytest.mark.promise("STATUS-4")
def test_canceled_is_reached_only_through_canceling() -> None:
    before = [status for (status, _), after in TRANSITIONS.items() if after.name == "CANCELED"]
    assert before == [GoalStatus.CANCELING]


@pytest.mark.promise("STATUS-1")
def test_statuses_have_the_numbers_of_ros() -> None:
    assert {status.name: status.value for status in GoalStatus} == {
        "UNKNOWN": 0,
        "ACCEPTED": 1,
        "EXECUTING": 2,
        "CANCELING": 3,
        "SUCCEEDED": 4,
        "CANCELED": 5,
        "ABORTED": 6,
    }


@pytest.mark.promise("STATUS-2")
def test_events_have_the_numbers_of_ros() -> None:
    assert {event.name: event.value for event in GoalEvent} == {
        "EXECUTE": 0,
        "CANCEL_GOAL": 1,
        "SUCCEED": 2,
        "ABORT": 3,
        "CANCELED": 4,
    }


@pytest.mark.promise("STATUS-3")
def test_a_goal_begins_as_accepted() -> None:
    assert INITIAL is GoalStatus.ACCEPTED


class GoalWalk(RuleBasedStateMachine):
    """A goal meets random events; its status has to agree with three plain facts about it."""

    def __init__(self) -> None:
        super().__init__()
        self.statuses = [INITIAL]
        self.started = False
        self.asked_to_cancel = False
        self.end = ""

    def happens(self, event: GoalEvent, *, allowed: bool) -> bool:
        before = self.statuses[-1]
        try:
            self.statuses.append(transition(before, event))
        except InvalidTransition:
            assert not allowed, f"{event.name} was refused while {before.name}"
        else:
            assert allowed, f"{event.name} was allowed while {before.name}"
        return allowed

    @rule()
    def execute(self) -> None:
        fresh = not (self.started or self.asked_to_cancel or self.end)
        self.started |= self.happens(GoalEvent.EXECUTE, allowed=fresh)

    @rule()
    def cancel(self) -> None:
        first = not (self.asked_to_cancel or self.end)
        self.asked_to_cancel |= self.happens(GoalEvent.CANCEL_GOAL, allowed=first)

    @rule(event=strategies.sampled_from([GoalEvent.SUCCEED, GoalEvent.ABORT]))
    def end_by_itself(self, event: GoalEvent) -> None:
        begun = (self.started or self.asked_to_cancel) and not self.end
        if self.happens(event, allowed=begun):
            self.end = {GoalEvent.SUCCEED: "SUCCEEDED", GoalEvent.ABORT: "ABORTED"}[event]

    @rule()
    def end_as_canceled(self) -> None:
        if self.happens(GoalEvent.CANCELED, allowed=self.asked_to_cancel and not self.end):
            self.end = "CANCELED"

    @invariant()
    def the_status_says_what_happened(self) -> None:
        expected = "EXECUTING" if self.started else "ACCEPTED"
        if self.asked_to_cancel:
            expected = "CANCELING"
        assert self.statuses[-1].name == (self.end or expected)

    @invariant()
    def canceled_comes_only_after_canceling(self) -> None:
        if self.statuses[-1] is GoalStatus.CANCELED:
            assert self.statuses[-2] is GoalStatus.CANCELING

    @invariant()
    def a_goal_is_active_until_its_end(self) -> None:
        assert self.statuses[-1].is_active == (not self.end)
        assert self.statuses[-1].is_terminal == bool(self.end)


TestGoalWalk = GoalWalk.TestCase
TestGoalWalk.settings = settings(stateful_step_count=12)


class Report(pydantic.BaseModel):
    status: GoalStatus
    before: list[GoalStatus] = []


def test_a_status_in_a_pydantic_model_is_its_name_in_json() -> None:
    report = Report(status=GoalStatus.EXECUTING, before=[GoalStatus.ACCEPTED])
    text = report.model_dump_json()
    assert text == '{"status":"EXECUTING","before":["ACCEPTED"]}'
    assert Report.model_validate_json(text) == report
    assert Report.model_validate({"status": 2, "before": [1]}) == report
    assert report.model_dump()["status"] is GoalStatus.EXECUTING
    shown = Report.model_json_schema(mode="serialization")["properties"]["status"]
    assert shown["enum"] == [status.name for status in GoalStatus]
    for unknown in ("RUNNING", 9):
        with pytest.raises(pydantic.ValidationError, match="'EXECUTING'"):
            Report.model_validate({"status": unknown})


def test_a_status_in_a_message_of_pydantic_passes_the_check_of_its_schema() -> None:
    action = Action("report", goal=Report, feedback=int, result=str)
    goals = GoalCodec(action.info.goal)
    for status in (GoalStatus.EXECUTING, "EXECUTING", 2):
        payload = goals.encode({"status": status})
        assert action.goal.decode(payload) == Report(status=GoalStatus.EXECUTING)
    goals.check(msgspec.msgpack.decode(action.goal.encode(Report(status=GoalStatus.ABORTED))))
