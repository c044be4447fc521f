"""The store for tests keeps, loses, delays and fails writes as it is told."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio.lowlevel import checkpoint
from msgspec.structs import replace

from fibaction import GoalID, GoalStatus
from fibaction.border.goal_store import GoalTaken, StoredGoal
from fibaction.words.errors import StoreError
from fibaction.words.goals import UNKNOWN_SENDER
from tests.support.memory_store import Fate, MemoryJournal, MemoryStore
from tests.support.virtual_time import in_virtual_time

SECOND = 1_000_000_000

pytestmark = pytest.mark.anyio


class Answers:
    """The answers to writes, in their order."""

    def __init__(self) -> None:
        self.got: list[tuple[str, StoreError | None]] = []

    def to(self, name: str) -> Callable[[StoreError | None], None]:
        return lambda error: self.got.append((name, error))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.got]


@pytest.fixture
def answers() -> Answers:
    return Answers()


def goal(number: int = 1, **more: Any) -> StoredGoal:
    return StoredGoal(
        GoalID(number.to_bytes(16, "big")), number, UNKNOWN_SENDER, b"digest", b"goal", **more
    )


def ended(one: StoredGoal, **more: Any) -> StoredGoal:
    return replace(one, status=GoalStatus.SUCCEEDED, result=b"result", ended_at=one.stamp, **more)


@asynccontextmanager
async def opened(
    store: MemoryStore, *, max_results: int = 1000
) -> AsyncGenerator[tuple[MemoryJournal, list[StoredGoal]], None]:
    """Open the store, and give the journal and the goals that were claimed."""
    claimed: list[StoredGoal] = []
    async with store.open(
        "act", max_results=max_results, claim=claimed.append, lose=lambda _: None
    ) as journal:
        yield journal, claimed


async def turns() -> None:
    for _ in range(5):
        await checkpoint()


async def test_a_write_is_answered_in_a_later_turn_and_in_order(answers: Answers) -> None:
    async with opened(MemoryStore()) as (journal, _):
        journal.accept(goal(), answers.to("first"))
        journal.accept(goal(2), answers.to("second"))
        assert answers.got == []
        await turns()
        assert answers.got == [("first", None), ("second", None)]


async def test_only_what_a_method_is_about_is_kept(answers: Answers) -> None:
    store, one = MemoryStore(), goal()
    async with opened(store) as (journal, _):
        journal.accept(one, answers.to("accept"))
        one.is_running, one.attempt, one.lost, one.checkpoint = True, 2, 1, b"unsaid"
        journal.begin(one, answers.to("begin"))
        one.status, one.attempt = GoalStatus.CANCELING, 3
        journal.cancel(one, answers.to("cancel"))
        await turns()
        (kept,) = store.goals.values()
        assert (kept.is_running, kept.attempt, kept.lost) == (True, 2, 1)
        assert (kept.status, kept.checkpoint) == (GoalStatus.CANCELING, None)
        one.checkpoint, one.is_running = b"said", False
        journal.checkpoint(one, answers.to("checkpoint"))
        journal.release(one, answers.to("release"))
        await turns()
        (kept,) = store.goals.values()
        assert (kept.checkpoint, kept.is_running) == (b"said", False)


@in_virtual_time()
async def test_writes_can_take_time_and_stay_in_order(answers: Answers) -> None:
    store = MemoryStore()
    delays = iter([2.0, 0.0])
    store.delay = lambda: next(delays)
    begun = anyio.current_time()
    async with opened(store) as (journal, _):
        journal.accept(goal(1), answers.to("first"))
        journal.accept(goal(2), answers.to("second"))
        await anyio.sleep(1)
        assert answers.got == []
    assert answers.names == ["first", "second"]  # the end of the block has waited
    assert anyio.current_time() == begun + 2


@pytest.mark.parametrize(("fate", "is_kept"), [(Fate.FAILED, False), (Fate.DOUBTFUL, True)])
async def test_after_a_failure_all_writes_fail(answers: Answers, fate: Fate, is_kept: bool) -> None:
    store = MemoryStore(lambda number, _: fate if number == 2 else Fate.KEPT)
    async with opened(store) as (journal, _):
        for number in (1, 2, 3):
            journal.accept(goal(number), answers.to(str(number)))
        await turns()
    assert [type(error) for _, error in answers.got] == [type(None), StoreError, StoreError]
    assert len(store.goals) == 1 + is_kept


async def test_a_goal_can_be_taken_by_another_server(answers: Answers) -> None:
    store = MemoryStore(lambda number, _: Fate.TAKEN if number == 1 else Fate.KEPT)
    async with opened(store) as (journal, _):
        journal.accept(goal(1), answers.to("taken"))
        journal.accept(goal(2), answers.to("mine"))
        await turns()
    assert [type(error) for _, error in answers.got] == [GoalTaken, type(None)]
    assert len(store.goals) == 1


@pytest.mark.parametrize(("fate", "is_kept"), [(Fate.LOST, False), (Fate.UNANSWERED, True)])
async def test_a_dead_process_keeps_nothing_and_is_answered_nothing(
    answers: Answers, fate: Fate, is_kept: bool
) -> None:
    store = MemoryStore(lambda number, _: fate if number == 2 else Fate.KEPT)
    deaths: list[str] = []
    store.on_death = lambda: deaths.append("dead")
    async with opened(store) as (journal, _):
        journal.accept(goal(1), answers.to("first"))
        journal.accept(goal(2), answers.to("second"))
        await turns()
        journal.accept(goal(3), answers.to("third"))
        await turns()
        assert answers.names == ["first"]
        assert deaths == ["dead"]
        async with opened(store) as (_, claimed):  # the next process
            assert len(claimed) == 1 + is_kept
        store.bury()
        assert answers.names == ["first", "second"]


async def test_of_the_writes_under_way_some_survive_a_death(answers: Answers) -> None:
    store = MemoryStore()
    async with opened(store) as (journal, _):
        store.hold()
        for number in (1, 2, 3):
            journal.accept(goal(number), answers.to("accept"))
        store.die(applied=2)
    assert (len(store.goals), answers.got) == (2, [])


async def test_what_is_kept_is_told(answers: Answers) -> None:
    store, one, kept = MemoryStore(), goal(), list[str]()
    store.on_kept = lambda what, goal: kept.append(f"{what} {goal.stamp}")
    store.on_claim = lambda goal: kept.append(f"claim {goal.stamp}")
    store.on_forget = lambda goal: kept.append(f"forget {goal.stamp}")
    async with opened(store) as (journal, _):
        journal.accept(one, answers.to("accept"))
        journal.end(ended(one), answers.to("end"))
        await turns()
    async with opened(store):
        assert kept == ["accept 1", "end 1", "claim 1"]
    async with opened(store, max_results=0):
        assert kept[3:] == ["forget 1"]


@pytest.mark.parametrize("wrong", ["begin", "end", "accept"])
async def test_a_write_that_makes_no_sense_is_found(answers: Answers, wrong: str) -> None:
    one = goal()
    with pytest.RaisesGroup(AssertionError, flatten_subgroups=True):
        async with opened(MemoryStore()) as (journal, _):
            if wrong != "begin":
                journal.accept(one, answers.to("accept"))
            if wrong == "end":
                journal.end(ended(one), answers.to("end"))
            getattr(journal, wrong)(ended(one), answers.to("wrong"))
