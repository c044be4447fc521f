"""The values that servers and stores exchange."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from fibaction import SqliteStore
from fibaction.border.goal_store import IntakeSource, NoFleet, no_obstacle
from fibaction.testing.contract.stores import a_goal
from fibaction.words.statuses import GoalStatus


@pytest.mark.parametrize(
    ("status", "attempt", "told"),
    [
        (GoalStatus.ACCEPTED, 0, GoalStatus.ACCEPTED),
        (GoalStatus.ACCEPTED, 2, GoalStatus.EXECUTING),
        (GoalStatus.CANCELING, 1, GoalStatus.CANCELING),
        (GoalStatus.SUCCEEDED, 1, GoalStatus.SUCCEEDED),
    ],
)
def test_an_active_goal_that_has_begun_is_executing_for_clients(
    status: GoalStatus, attempt: int, told: GoalStatus
) -> None:
    goal = a_goal(1)
    goal.status, goal.attempt = status, attempt
    assert goal.told_status is told


def test_a_goal_is_listed_with_its_times_and_the_start_of_its_reason() -> None:
    goal = a_goal(1)
    assert (goal.info.began_at, goal.info.ended_at, goal.info.reason) == (None, None, "")
    goal.status, goal.attempt, goal.reason = GoalStatus.ABORTED, 2, "stuck " * 100
    goal.began_at, goal.ended_at = goal.stamp + 1, goal.stamp + 2
    info = goal.info
    assert (info.goal_id, info.stamp, info.status) == (goal.goal_id, goal.stamp, GoalStatus.ABORTED)
    assert (info.began_at, info.ended_at) == (goal.stamp + 1, goal.stamp + 2)
    assert (info.attempt, len(info.reason)) == (2, 200)


@pytest.mark.asyncio
async def test_the_goals_of_a_store_without_leases_belong_to_their_server_for_ever(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db")
    async with store.open("paint", max_results=9, claim=print, lose=print) as journal:
        assert journal.valid_until == math.inf


@pytest.mark.asyncio
async def test_a_store_of_one_server_has_no_limits_for_a_fleet(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "goals.db")
    async with store.open("paint", max_results=9, claim=print, lose=print) as journal:
        with pytest.raises(NoFleet, match="fleet_limit='arms' needs a fleet"):
            await journal.key_slots("arms", 1)


def test_a_list_of_a_history_has_all_of_a_goal_but_its_request_and_its_result() -> None:
    meta = {"order": "17", "traceparent": "00-1"}
    goal = a_goal(1)
    goal.status, goal.ended_at, goal.reason, goal.meta = GoalStatus.ABORTED, 5, "x" * 300, meta
    goal.result, goal.checkpoint = b"result", b"half"
    line = goal.listed()
    assert (line.goal, line.result, line.checkpoint) == (b"", None, None)
    assert line.info == goal.info
    assert (line.meta, len(line.reason)) == ({"order": "17"}, 200)
    assert (goal.result, goal.meta, len(goal.reason)) == (b"result", meta, 300)


def test_a_goal_that_was_given_up_is_one_that_has_ended_and_is_kept_whole() -> None:
    goal = a_goal(1, checkpoint=b"half")
    assert not goal.is_given_up, "it is active"
    goal.status = GoalStatus.ABORTED
    assert goal.is_given_up
    goal.drop_request()
    assert (goal.goal, goal.checkpoint, goal.meta) == (b"", None, None)
    goal.drop_request()  # nothing is left to forget
    assert (goal.goal, goal.checkpoint, goal.meta) == (b"", None, None)
    assert not goal.is_given_up


def test_a_goal_that_was_given_up_is_a_new_one_when_it_runs_again() -> None:
    goal = a_goal(1, checkpoint=b"half", attempt=3, lost=3, deadline=5, reason="given up")
    goal.status = GoalStatus.ABORTED
    new = goal.as_new(9)
    assert new.goal_id == goal.as_new(10).goal_id
    assert new.goal_id not in (goal.goal_id, new.as_new(9).goal_id)
    expected = a_goal(1, checkpoint=b"half")
    expected.goal_id, expected.stamp = new.goal_id, 9
    assert new == expected


def test_a_server_that_names_no_obstacle_runs_every_goal() -> None:
    assert no_obstacle(a_goal(1)) == ""


@pytest.mark.asyncio
async def test_an_intake_is_kept_in_memory_unless_the_store_keeps_it() -> None:
    source = IntakeSource()
    assert await source.intake() == b""
    assert await source.change_intake(lambda kept: kept + b"1") == b"1"
    assert (await source.intake(), source.intake_period) == (b"1", math.inf)
