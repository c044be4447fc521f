"""The tests that each goal store passes: a module of tests imports `*`. See the package."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from threading import get_ident
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle, GoalStatus, StoreError
from fibaction.border.goal_store import GoalJournal, GoalStore, StoredGoal
from fibaction.words.goals import GoalID, Sender

pytestmark = pytest.mark.anyio


class Kept:
    """An open journal whose writes are waited for."""

    def __init__(self, journal: GoalJournal, found: list[StoredGoal]) -> None:
        self.journal = journal
        self.found = found

    async def __call__(self, write: Callable[..., None], goal: StoredGoal) -> None:
        told = anyio.Event()
        errors: list[StoreError | None] = []
        thread = get_ident()

        def then(error: StoreError | None) -> None:
            assert get_ident() == thread
            errors.append(error)
            told.set()

        write(goal, then)
        assert not errors  # it returns before anything is written
        await told.wait()
        if errors[0] is not None:
            raise errors[0]


@asynccontextmanager
async def opened(
    store: GoalStore, action: str = "paint", max_results: int = 100
) -> AsyncIterator[Kept]:
    """Open a store, with the goals that it has claimed."""
    found: list[StoredGoal] = []
    async with store.open(
        action, max_results=max_results, claim=found.append, lose=lambda goal_id: None
    ) as journal:
        yield Kept(journal, found)


def a_goal(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal whose ID and stamp are the number."""
    goal_id = GoalID(number.to_bytes(16, "big"))
    sender = Sender("robot", b"owner", "here")
    fields = {"meta": {"traceparent": f"00-{number}"}, **fields}
    return StoredGoal(goal_id, number, sender, b"digest", b"goal", **fields)


def after_end(goal: StoredGoal, /, **fields: Any) -> StoredGoal:
    """Set the fields of an end, and return the goal, without what was needed only to run it."""
    goal.drop_request()
    goal.status, goal.is_running, goal.ended_at = GoalStatus.SUCCEEDED, False, 5
    goal.result = b"result"
    for name, value in fields.items():
        setattr(goal, name, value)
    return goal


async def test_each_step_is_kept(store: GoalStore) -> None:
    goal = a_goal(deadline=7)
    async with opened(store) as kept:
        assert kept.found == []
        await kept(kept.journal.accept, goal)
        goal.is_running, goal.attempt, goal.began_at = True, 1, 8
        await kept(kept.journal.begin, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        goal.checkpoint = b"half"
        await kept(kept.journal.checkpoint, goal)
        goal.status = GoalStatus.CANCELING
        await kept(kept.journal.cancel, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        goal.is_running = False
        await kept(kept.journal.release, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        await kept(kept.journal.end, after_end(goal, reason="done ü", feedback_count=3))
    async with opened(store) as kept:
        assert kept.found == [goal]


async def test_a_goal_that_begins_at_once_is_kept_with_its_acceptance(store: GoalStore) -> None:
    goal = a_goal(is_running=True, attempt=1, began_at=2)
    async with opened(store) as kept:
        await kept(kept.journal.accept, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]


async def test_goals_come_by_their_ends_and_then_by_their_stamps(store: GoalStore) -> None:
    async with opened(store) as kept:
        for number in (5, 1, 4, 2, 3):
            await kept(kept.journal.accept, a_goal(number))
        for ended_at, number in enumerate((3, 1), 1):
            await kept(kept.journal.end, after_end(a_goal(number), ended_at=ended_at))
    for _ in range(2):
        async with opened(store) as kept:
            assert [goal.stamp for goal in kept.found] == [3, 1, 2, 4, 5]


async def test_the_oldest_results_are_forgotten_when_there_are_too_many(store: GoalStore) -> None:
    async with opened(store) as kept:
        for number in range(1, 5):
            await kept(kept.journal.accept, a_goal(number))
            await kept(kept.journal.end, after_end(a_goal(number), ended_at=number))
        await kept(kept.journal.accept, a_goal(5))
    async with opened(store, max_results=2) as kept:
        assert [goal.stamp for goal in kept.found] == [3, 4, 5]
    async with opened(store) as kept:
        assert [goal.stamp for goal in kept.found] == [3, 4, 5]


async def test_results_whose_time_has_passed_are_forgotten_at_a_start(store: GoalStore) -> None:
    async with opened(store) as kept:
        for number, until in enumerate([0, 1, time.time_ns() + 10**12], 1):
            await kept(kept.journal.accept, a_goal(number))
            end = after_end(a_goal(number), ended_at=number, keep_until=until)
            await kept(kept.journal.end, end)
    async with opened(store) as kept:
        assert [goal.stamp for goal in kept.found] == [1, 3]


async def test_a_goal_that_was_given_up_is_kept_whole(store: GoalStore) -> None:
    goal = a_goal(checkpoint=b"half")
    async with opened(store) as kept:
        await kept(kept.journal.accept, a_goal())
        await kept(kept.journal.checkpoint, goal)
        goal.status, goal.reason, goal.ended_at = GoalStatus.ABORTED, "given up", 5
        await kept(kept.journal.end, goal)
    async with opened(store) as kept:
        assert kept.found == [goal]
        assert kept.found[0].is_given_up


async def test_an_id_may_be_used_again_after_the_end(store: GoalStore) -> None:
    async with opened(store) as kept:
        await kept(kept.journal.accept, a_goal())
        await kept(kept.journal.end, after_end(a_goal()))
        await kept(kept.journal.accept, a_goal(deadline=9))
    async with opened(store) as kept:
        assert kept.found == [a_goal(deadline=9)]


async def test_the_end_of_the_block_waits_for_what_is_written(store: GoalStore) -> None:
    told: list[tuple[int, StoreError | None]] = []

    def note(number: int, error: StoreError | None) -> None:
        told.append((number, error))

    async with opened(store, "drive"):
        async with opened(store) as paint:
            for number in range(1, 100):
                paint.journal.accept(a_goal(number), partial(note, number))
        assert told == [(number, None) for number in range(1, 100)]
        async with opened(store) as paint:
            assert len(paint.found) == 99
            for number in range(1, 100):
                goal = after_end(a_goal(number))
                paint.journal.end(goal, partial(note, -number))
    assert told[99:] == [(-number, None) for number in range(1, 100)]


async def test_a_block_that_is_canceled_waits_for_its_writes(store: GoalStore) -> None:
    told: list[object] = []
    with anyio.CancelScope() as scope:
        async with opened(store) as kept:
            kept.journal.accept(a_goal(), told.append)
            scope.cancel()
            await anyio.sleep_forever()
    assert told == [None]


async def test_a_goal_that_changes_after_a_call_is_kept_as_it_was(store: GoalStore) -> None:
    goal = a_goal()
    async with opened(store) as kept:
        kept.journal.accept(goal, lambda error: None)
        goal.status = GoalStatus.CANCELING
    async with opened(store) as kept:
        assert kept.found == [a_goal()]


async def test_stores_of_several_actions_are_opened_at_once(store: GoalStore) -> None:
    async def use(action: str) -> None:
        for number in range(1, 4):
            async with opened(store, action) as kept:
                assert len(kept.found) == number - 1
                await kept(kept.journal.accept, a_goal(number))

    async with anyio.create_task_group() as tasks:
        for number in range(5):
            tasks.start_soon(use, f"action{number}")


async def test_an_action_is_served_once(store: GoalStore) -> None:
    async with opened(store) as kept:
        with pytest.raises(StoreError):
            async with opened(store):
                pass
        await kept(kept.journal.accept, a_goal())
    async with opened(store) as kept:
        assert kept.found == [a_goal()]


COUNT = Action("count", goal=int, feedback=int, result=str, checkpoint=int)


async def test_a_goal_continues_at_its_checkpoint_after_a_planned_stop(store: GoalStore) -> None:
    go = anyio.Event()

    async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        done = goal.restored or 0
        while done < goal.request:
            await goal.checkpoint(done := done + 1)
            yield done
            if done == 2:
                await go.wait()
        yield f"{done} in attempt {goal.attempt}"

    async with ActionServer(COUNT, count, store=store, at_stop="keep") as server:
        goal = await ActionClient(server, COUNT).send_goal(3)
        assert await anext(goal.feedback) == 1
        assert await anext(goal.feedback) == 2
    go.set()
    async with ActionServer(COUNT, count, store=store) as server:
        again = await ActionClient(server, COUNT).attach(goal.goal_id)
        assert await again.result() == "3 in attempt 2"
    async with ActionServer(COUNT, count, store=store) as server:
        ended = await ActionClient(server, COUNT).attach(goal.goal_id)
        assert await ended.result() == "3 in attempt 2"


__all__ = ["pytestmark", *(name for name in dir() if name.startswith("test_"))]
