"""The store for tests keeps, loses and rejects writes as it is told, beside the contract."""

from __future__ import annotations

import pytest
from anyio.lowlevel import checkpoint

from fibaction import GoalStatus
from fibaction.testing.contract.stores import a_goal, after_end, opened
from fibaction.words.errors import StoreError
from tests.support.memory_store import Fate, MemoryStore

pytestmark = pytest.mark.anyio


async def test_only_what_a_method_is_about_is_kept() -> None:
    store, one = MemoryStore(), a_goal()
    async with opened(store) as kept:
        journal = kept.journal
        await kept(journal.accept, one)
        one.is_running, one.attempt, one.lost, one.checkpoint = True, 2, 1, b"unsaid"
        await kept(journal.begin, one)
        one.status, one.attempt = GoalStatus.CANCELING, 3
        await kept(journal.cancel, one)
        (found,) = store.goals.values()
        assert (found.is_running, found.attempt, found.lost) == (True, 2, 1)
        assert (found.status, found.checkpoint) == (GoalStatus.CANCELING, None)
        one.checkpoint, one.is_running = b"said", False
        await kept(journal.checkpoint, one)
        await kept(journal.release, one)
        (found,) = store.goals.values()
        assert (found.checkpoint, found.is_running) == (b"said", False)


@pytest.mark.parametrize(("fate", "is_kept"), [(Fate.LOST, False), (Fate.UNANSWERED, True)])
async def test_a_dead_process_keeps_nothing_and_is_answered_nothing(
    fate: Fate, is_kept: bool
) -> None:
    store = MemoryStore(lambda number, _: fate if number == 2 else Fate.KEPT)
    deaths: list[str] = []
    store.on_death = lambda: deaths.append("dead")
    answers: list[StoreError | None] = []
    async with opened(store) as kept:
        for number in (1, 2, 3):
            kept.journal.accept(a_goal(number), answers.append)
        for _ in range(5):
            await checkpoint()
        assert (answers, deaths) == ([None], ["dead"])
        async with opened(store) as following:  # the next process
            assert len(following.found) == 1 + is_kept
        store.bury()
        assert [type(error) for error in answers[1:]] == [StoreError] * 2


@pytest.mark.parametrize("wrong", ["begin", "end", "accept"])
async def test_a_write_that_makes_no_sense_is_found(wrong: str) -> None:
    with pytest.RaisesGroup(AssertionError, flatten_subgroups=True):
        async with opened(MemoryStore()) as kept:
            if wrong != "begin":
                await kept(kept.journal.accept, a_goal())
            if wrong == "end":
                await kept(kept.journal.end, after_end(a_goal()))
            getattr(kept.journal, wrong)(after_end(a_goal()), lambda _: None)
