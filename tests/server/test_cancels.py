"""`fibaction.server.cancels`: cancels of goals, beyond what the contract suite shows."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
)
from tests.server.held import Held, packed, start_many, turns_during
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci
from tests.support.matching import End
from tests.support.slices import let_slices_last

pytestmark = pytest.mark.anyio


def agree(goal: Goal) -> None:
    """A callback that has nothing against it."""


@pytest.mark.promise("CANCEL-13")
async def test_a_goal_that_is_canceled_before_its_start_never_runs() -> None:
    executor = Held()
    async with ActionServer(FIBONACCI, executor, interrupt_on_cancel=False) as server:
        stream = await server.send_goal(GoalID.random(), packed(1))
        assert (await server.cancel_goals(stream.goal_id)).accepted
        assert await stream.outcome() == End(GoalStatus.CANCELED)
    assert not executor.begun.is_set()


@pytest.fixture
def no_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every slice is over at once."""
    let_slices_last(monkeypatch, -1.0)


@pytest.mark.promise("CANCEL-23")
@pytest.mark.usefixtures("no_slice")
@pytest.mark.parametrize("on_cancel", [None, agree], ids=["no on_cancel", "a sync one"])
async def test_a_cancel_of_many_goals_gives_others_their_turns(on_cancel: Any) -> None:
    async with ActionServer(FIBONACCI, Held(), on_cancel=on_cancel) as server:
        streams = await start_many(server, 30)
        for _ in range(2):  # the second one finds goals that are canceling, or have ended
            assert await turns_during(server.cancel_goals()) > 20
            await start_many(server, 30)
        assert {(await stream.outcome()).status for stream in streams} == {GoalStatus.CANCELED}


async def test_on_cancel_is_asked_about_a_hundred_goals_at_the_same_time() -> None:
    asked: list[GoalID] = []
    decide = anyio.Event()

    async def on_cancel(goal: GoalHandle[Goal]) -> None:
        asked.append(goal.goal_id)
        await decide.wait()

    async with ActionServer(FIBONACCI, Held(), on_cancel=on_cancel) as server:
        streams = await start_many(server, 120)
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(server.cancel_goals)
            await anyio.wait_all_tasks_blocked()
            assert len(asked) == 100
            decide.set()
        assert set(asked) == {stream.goal_id for stream in streams}


@pytest.mark.promise("ACCEPT-13")
async def test_a_reason_for_a_rejection_is_cut_before_it_is_told_and_kept() -> None:
    def on_goal(goal: Goal) -> None:
        raise GoalRejected("no" * 1000)

    async with ActionServer(FIBONACCI, fibonacci, on_goal=on_goal) as server:
        goal_id = GoalID.random()
        for _ in range(2):
            with pytest.raises(GoalRejected) as caught:
                await server.send_goal(goal_id, packed(1))
            assert caught.value.reason == "no" * 499 + "n…"
