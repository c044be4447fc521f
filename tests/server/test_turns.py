"""`fibaction.server.execution.turns`: one executor that does not wait in each turn of the event
loop."""

from __future__ import annotations

from collections import defaultdict, deque

import anyio
import anyio.lowlevel
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.server.execution.turns import EXECUTOR_SLICE, FEW, FairQueue, Turns

pytestmark = pytest.mark.anyio


async def test_one_goes_on_in_each_turn_and_keys_take_turns() -> None:
    turns = Turns()
    seen: list[str] = []

    async def runs(key: str) -> None:
        while len(seen) < 60:
            await turns.pause(key)
            seen.append(key)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            for _ in range(20):
                tasks.start_soon(runs, "many")
            tasks.start_soon(runs, "few")
            most = before = 0
            while len(seen) < 60:
                await anyio.lowlevel.checkpoint()
                most = max(most, len(seen) - before)
                before = len(seen)
    assert most <= 2  # trio, which draws the order of tasks, may let two turns follow each other
    assert 20 <= seen[:60].count("few") <= 31


async def test_those_that_are_canceled_keep_no_other_waiting() -> None:
    turns = Turns()
    went_on: list[str] = []

    async def runs(key: str, scope: anyio.CancelScope) -> None:
        with scope:
            await turns.pause(key)
            went_on.append(key)

    scopes = {key: anyio.CancelScope() for key in "abcd"}
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            turns._is_passing = True
            for key, scope in scopes.items():
                tasks.start_soon(runs, key, scope)
                await anyio.wait_all_tasks_blocked()
            scopes["a"].cancel()
            scopes["c"].cancel()
            await anyio.wait_all_tasks_blocked()
            turns._pass_on()
        assert went_on == ["b", "d"]
        await turns.pause("a")
    assert not turns._gone


async def test_the_more_wait_the_shorter_is_a_slice() -> None:
    turns = Turns()
    async with anyio.create_task_group() as tasks:
        for number in range(1 + 4 * FEW):
            tasks.start_soon(turns.pause, number)
        shortest = turns.slice
        while turns.slice == EXECUTOR_SLICE:
            await anyio.lowlevel.checkpoint()
        while turns.slice < EXECUTOR_SLICE:
            shortest = min(shortest, turns.slice)
            await anyio.lowlevel.checkpoint()
    assert 0.25 <= shortest / EXECUTOR_SLICE < 0.3
    assert turns.slice == EXECUTOR_SLICE


# The queue in which keys take turns


@given(st.lists(st.one_of(st.none(), st.integers(0, 3))))
def test_it_gives_each_item_once_in_turns_and_keeps_no_key_without_items(
    steps: list[int | None],
) -> None:
    queue: FairQueue[int] = FairQueue()
    waiting: defaultdict[int, deque[int]] = defaultdict(deque)
    passed_over: defaultdict[int, int] = defaultdict(int)
    keys: dict[int, int] = {}
    for number, key in enumerate(steps):
        if key is not None:
            keys[number] = key
            queue.append(number, key)
            waiting[key].append(number)
        elif queue.count:
            item = queue.popleft()
            taken = keys[item]
            assert waiting[taken].popleft() == item
            passed_over[taken] = 0
            for other, items in waiting.items():
                passed_over[other] = passed_over[other] + 1 if items and other != taken else 0
                assert passed_over[other] <= 3  # as many as there are other keys
        assert queue.count == sum(map(len, waiting.values()))
        assert len(queue._items) == len(queue._turns) <= 1 + sum(map(bool, waiting.values()))
