from __future__ import annotations

import msgspec
import pydantic
import pytest

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
