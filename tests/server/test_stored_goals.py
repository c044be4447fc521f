"""Stored goals that a new version of an action cannot read: the server does not start."""

from __future__ import annotations

import copy
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalStatus,
    Schedule,
    SqliteStore,
    StoreError,
)
from fibaction.border.goal_store import StoredGoal
from tests.server.held import id_of
from tests.server.painting import PAINT, paint, server_with, store_with, stored
from tests.server.test_keeper import attached
from tests.support.memory_store import MemoryStore

pytestmark = pytest.mark.anyio


class Wall(msgspec.Struct):
    """A goal of the old version."""

    square_meters: int


class ColouredWall(Wall):
    """A goal of the new version, with one more required field."""

    colour: str


OLD = Action("paint", goal=Wall, feedback=int, result=str)
NEW = Action("paint", goal=ColouredWall, feedback=int, result=str)


async def work(goal: GoalHandle[Any]) -> AsyncGenerator[int | str, None]:
    yield f"painted {goal.request.square_meters}"


async def wait(goal: GoalHandle[Any]) -> AsyncGenerator[int | str, None]:
    yield 1
    await anyio.sleep_forever()


async def refusal(server: ActionServer[Any, Any, Any]) -> str:
    """Return the error of the start."""
    with pytest.raises(StoreError) as caught:
        await server.__aenter__()
    return str(caught.value)


@pytest.mark.promise("KEEP-11")
async def test_after_a_bad_deploy_the_server_does_not_start_and_the_old_version_goes_on(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db")
    async with ActionServer(OLD, wait, store=store, at_stop="keep") as old:
        goal = await ActionClient(old, OLD).send_goal(Wall(3))
        await anext(goal.feedback)

    for _ in range(2):
        assert await refusal(ActionServer(NEW, work, store=store)) == (
            f"the store has 1 goal that this version of action 'paint' cannot read"
            f" ({goal.goal_id}): Object missing required field `colour`; nothing was changed: start"
            f" the version that accepted them, or end them as ABORTED with unreadable='abort'"
        )

    async with ActionServer(OLD, work, store=store) as old:
        again = await ActionClient(old, OLD).attach(goal.goal_id)
        assert await again.result() == "painted 3"


@pytest.mark.promise("KEEP-11")
async def test_a_refusal_names_the_first_goals_and_runs_and_writes_nothing() -> None:
    store = store_with(stored(number=1), *(stored("three", number=n) for n in range(2, 7)))
    before = copy.deepcopy(store.goals)

    text = await refusal(server_with(store))

    assert text.startswith(
        f"the store has 5 goals that this version of action 'paint' cannot read"
        f" ({id_of(2)}, {id_of(3)}, {id_of(4)}, and others): Expected `int`"
    )
    assert (store.goals, store.writes) == (before, 0)


async def test_a_checkpoint_that_does_not_fit_is_refused() -> None:
    text = await refusal(server_with(store_with(stored(checkpoint=b"\xa1x"))))
    assert "(00000000000000000000000000000001): Expected `int`" in text


def fail(_goal: int) -> Any:
    raise KeyError("colour")


def later(_goal: int) -> Any:
    return anyio.sleep(1)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"key": fail}, "key failed: KeyError: 'colour'"),
        ({"priority": fail}, "priority failed: KeyError: 'colour'"),
        ({"key": later}, "key failed: TypeError: it returned something to await, and not a value"),
    ],
    ids=["key", "priority", "key to await"],
)
async def test_a_goal_for_which_a_function_of_the_schedule_fails_is_refused(
    settings: Any, reason: str
) -> None:
    schedule = Schedule(concurrency=1, **settings)
    assert f"): {reason}; nothing" in await refusal(
        server_with(store_with(stored()), schedule=schedule)
    )
    async with server_with(store_with(stored()), schedule=schedule, unreadable="abort") as server:
        outcome = await (await attached(server)).outcome()
    assert (outcome.status, outcome.reason) == (GoalStatus.ABORTED, reason)


@pytest.mark.parametrize(
    ("goal", "recovery", "status"),
    [
        (stored("three", status=GoalStatus.CANCELING, attempt=1), "rerun", GoalStatus.CANCELED),
        (stored("three", is_running=True, attempt=1), "abort", GoalStatus.ABORTED),
        (stored("three", is_running=True, attempt=3, lost=2), "rerun", GoalStatus.ABORTED),
        (stored("three", status=GoalStatus.SUCCEEDED, result=b"\xa0"), "rerun", None),
    ],
    ids=["canceled", "was running", "too many attempts", "has ended"],
)
async def test_a_goal_that_does_not_run_in_any_case_does_not_hinder_the_start(
    goal: StoredGoal, recovery: Any, status: GoalStatus | None
) -> None:
    schedule = Schedule(concurrency=1, key=int)
    async with server_with(store_with(goal), recovery=recovery, schedule=schedule) as server:
        outcome = await (await attached(server)).outcome()
    assert outcome.status is (status or GoalStatus.SUCCEEDED)


async def test_a_running_goal_that_would_run_again_is_refused() -> None:
    store = store_with(stored("three", is_running=True, attempt=2, lost=1))
    assert "cannot read" in await refusal(server_with(store, recovery="rerun"))


async def test_a_goal_that_is_handed_over_later_and_cannot_be_read_is_aborted() -> None:
    store = MemoryStore()
    async with ActionServer(PAINT, paint, store=store) as server:
        store.give("paint", stored("three"))
        await anyio.wait_all_tasks_blocked()
        outcome = await (await attached(server)).outcome()
    assert outcome.status is GoalStatus.ABORTED
    assert outcome.reason.startswith("the stored goal does not fit the action any more")
