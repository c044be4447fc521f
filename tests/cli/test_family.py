"""The parents and the children of goals, in `goals`, `attach` and `top`."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionInfo,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    Parent,
    serve,
)
from fibaction.cli.output.goal_table import Family, family_of, step_of
from fibaction.cli.verbs.follow import attach
from fibaction.cli.verbs.list_goals import Form, list_goals
from fibaction.observe.monitor import GoalKey, GoalSnapshot, Monitor

URL = "inproc://family"
DRIVE = Action("drive", goal=str, feedback=int, result=str)
FETCH = Action("base/fetch", goal=str, feedback=int, result=str)
MISSION, LEG, PART = (GoalID(bytes([number]) * 16) for number in (0xAA, 0xBB, 0xCC))


async def drive(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    yield f"at the {goal.request}"


@asynccontextmanager
async def fetched() -> AsyncGenerator[tuple[str, str, str], None]:
    """Serve a mission that has driven twice; give its ID, and those of its children."""
    ids: list[str] = []

    async def fetch(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        for place in ("shelf", "dock"):
            step = goal.step(f"to the {place}")
            ids.append(str(step.child_id("drive")))
            await ActionClient(drives, DRIVE).call(place, step=step)
        yield "fetched"

    async with (
        ActionServer(DRIVE, drive) as drives,
        ActionServer(FETCH, fetch) as fetches,
        serve([drives, fetches], URL),
    ):
        goal = await ActionClient(fetches, FETCH).send_goal("cup")
        await goal.result()
        yield str(goal.goal_id), ids[0], ids[1]


@pytest.mark.asyncio
async def test_a_list_for_programs_has_the_parents_and_the_children(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async with fetched() as (mission, shelf, dock):
        await list_goals(URL, form=Form.JSON)

    found = {
        line["goal_id"]: line for line in map(json.loads, capsys.readouterr().out.split("\n")[:-1])
    }
    assert found[mission]["parent"] is None
    assert found[mission]["children"] == [shelf, dock]
    assert found[shelf]["parent"] == {"goal_id": mission, "step": "to the shelf"}
    assert found[dock]["children"] == []


@pytest.mark.asyncio
@pytest.mark.parametrize("as_json", [False, True])
async def test_attach_says_which_step_a_goal_is(
    as_json: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    async with fetched() as (mission, shelf, _):
        await attach(URL, shelf, None, full=False, as_json=as_json)
        await attach(URL, mission, None, full=False, as_json=as_json)

    lines = capsys.readouterr().out.splitlines()
    if as_json:
        child, parent = (json.loads(line) for line in lines if "accepted" in line)
        assert child["parent"] == {"goal_id": mission, "step": "to the shelf"}
        assert "parent" not in parent
    else:
        at = lines.index(f"Goal accepted with ID: {shelf}")
        assert lines[at + 1] == f"It is the step to the shelf of {mission}"
        at = lines.index(f"Goal accepted with ID: {mission}")
        assert lines[at + 1] == ""


def test_a_step_without_a_name_is_one_all_the_same_and_none_controls_the_terminal() -> None:
    assert step_of(Parent(MISSION), 8) == "step of aaaaaaaa"
    assert step_of(Parent(MISSION, "a\x1b[2J"), 8) == "a\\x1b[2J of aaaaaaaa"


def test_a_goal_may_be_a_step_and_have_children() -> None:
    leg = GoalInfo(LEG, 2, GoalStatus.EXECUTING, parent=Parent(MISSION, "drive"))
    family = Family([leg, GoalInfo(PART, 3, GoalStatus.EXECUTING, parent=Parent(LEG))])

    assert family.text(leg, 4) == "drive of aaaa, 1 child"
    assert not Family([GoalInfo(LEG, 2, GoalStatus.EXECUTING)])


def snapshot(monitor: Monitor, goal_id: GoalID) -> GoalSnapshot:
    found = monitor.find(goal_id)
    assert found is not None
    return found


def test_the_details_of_a_goal_have_its_parent_and_its_children_with_their_states() -> None:
    monitor = Monitor()
    monitor.on_actions([ActionInfo("fetch"), ActionInfo("drive")], "")
    monitor.on_event("fetch", GoalInfo(MISSION, 1, GoalStatus.EXECUTING))
    monitor.on_event(
        "drive", GoalInfo(LEG, 2, GoalStatus.SUCCEEDED, parent=Parent(MISSION, "shelf"))
    )
    monitor.on_event("drive", GoalInfo(PART, 3, GoalStatus.EXECUTING, parent=Parent(MISSION)))

    assert family_of(monitor, snapshot(monitor, MISSION)).splitlines() == [
        "Children:",
        f"  shelf: {LEG}, /drive SUCCEEDED",
        f"  step: {PART}, /drive EXECUTING",
    ]
    assert family_of(monitor, snapshot(monitor, LEG)) == (
        f"Parent: shelf of {MISSION}, /fetch EXECUTING"
    )
    monitor.on_event("fetch", GoalInfo(MISSION, 0, GoalStatus.UNKNOWN))
    assert family_of(monitor, snapshot(monitor, LEG)) == (
        f"Parent: shelf of {MISSION}, of another server, or forgotten"
    )
    assert snapshot(monitor, LEG).key == GoalKey("drive", LEG)
