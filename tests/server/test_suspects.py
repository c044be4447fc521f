"""Goals that may have ended their process: they run alone, and what waits for them meanwhile."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import anyio
import pytest
from anyio import current_time

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    CancelCode,
    GoalHandle,
    GoalID,
    GoalStatus,
    Schedule,
)
from fibaction.border.goal_store import StoredGoal
from fibaction.server.execution.suspects import ALL_TRIALS, TRIAL, Suspects
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.goals import UNKNOWN_SENDER
from tests.server.held import id_of
from tests.server.painting import (
    PAINT,
    Painting,
    Server,
    client_of,
    server_with,
    store_with,
    stored,
)
from tests.support.memory_store import MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]

RERUN: dict[str, Any] = {"recovery": "rerun"}
WHY = "a suspect, which runs alone: 2 attempts have ended with their process"


def suspect(number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal that has lost its second attempt."""
    return stored(1, number, is_running=True, attempt=2, lost=1, **fields)


class Painter:
    """An executor of a second for each stroke, which notes when each goal begins and ends."""

    def __init__(self) -> None:
        self.began: dict[int, float] = {}
        self.ended: dict[int, float] = {}
        self.most = 0
        """The most goals that ran at the same time."""
        self._running = 0
        self.at_begin: Callable[[GoalHandle[int]], None] = lambda _goal: None

    async def __call__(self, goal: GoalHandle[int]) -> Painting:
        number = _number(goal.goal_id)
        self.began[number] = current_time()
        self._running += 1
        self.most = max(self.most, self._running)
        try:
            self.at_begin(goal)
            await anyio.sleep(goal.request)
        finally:
            self._running -= 1
        self.ended[number] = current_time()
        yield f"attempt {goal.attempt}"


def _number(goal_id: GoalID) -> int:
    return int.from_bytes(bytes(goal_id), "big")


async def ended(server: Server, *numbers: int) -> list[GoalStatus]:
    goals = [await client_of(server).attach(id_of(number)) for number in numbers]
    return [(await goal.outcome()).status for goal in goals]


@pytest.mark.promise("KEEP-13")
async def test_many_suspects_share_the_time_for_which_others_wait() -> None:
    painter, many = Painter(), range(1, 41)
    store = store_with(*(stored(10_000, one, is_running=True, attempt=2, lost=1) for one in many))
    before = current_time()
    async with server_with(store, painter, max_goals=100, **RERUN) as server:
        new = await client_of(server).send_goal(1, goal_id=id_of(99))
        await new.result()
        begins = sorted(painter.began[one] for one in many)
        assert all(later > one for one, later in pairwise(begins)), "one after another"
        assert TRIAL < painter.began[99] - before <= ALL_TRIALS
        await server.stop()


@pytest.mark.promise("KEEP-13")
@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=2, queue=9)])
async def test_suspects_run_alone_one_after_another_before_all_other_goals(
    schedule: Schedule | None, caplog: pytest.LogCaptureFixture
) -> None:
    painter, others = Painter(), [stored(1, 4), stored(1, 5, is_running=True, attempt=1)]
    store = store_with(*others, suspect(1), suspect(2), suspect(3))
    async with server_with(store, painter, schedule=schedule, **RERUN) as server:
        client = client_of(server)
        new = await client.send_goal(1, goal_id=id_of(6))
        infos = {info.goal_id: info for info in await client.goals()}
        assert infos[id_of(1)].reason == WHY
        assert infos[id_of(4)].reason == ""
        assert new.status is GoalStatus.ACCEPTED
        assert await ended(server, 1, 2, 3, 4, 5) == [GoalStatus.SUCCEEDED] * 5
        assert await new.result() == "attempt 1"
    on_trial = sorted((1, 2, 3), key=lambda number: painter.began[number])
    for number, later in pairwise(on_trial):
        assert painter.ended[number] <= painter.began[later]
    assert max(painter.ended[number] for number in (1, 2, 3)) <= min(
        painter.began[number] for number in (4, 5, 6)
    )
    assert {one.getMessage() for one in caplog.records if one.levelno == logging.WARNING} == {
        f"goal {id_of(number)} of action 'paint': {WHY}" for number in on_trial
    }


@pytest.mark.promise("KEEP-13")
async def test_other_servers_of_the_process_and_their_stores_wait_for_a_suspect() -> None:
    painter, others = Painter(), Painter()
    store = store_with(stored(1, 4))
    async with server_with(store_with(suspect(1)), painter, **RERUN) as server:
        other = ActionServer(Action("other", goal=int, feedback=int, result=str), others)
        async with server_with(store, others) as second, other:
            new = await ActionClient(other, other.action).send_goal(1, goal_id=id_of(5))
            assert store.rooms == [(0, 1)]
            assert await ended(server, 1) == await ended(second, 4) == [GoalStatus.SUCCEEDED]
            await new.result()
            assert store.rooms == [(0, 1), (math.inf, 0)]
    assert painter.ended[1] <= min(others.began.values())


async def test_a_suspect_waits_for_goals_that_run_but_not_for_ever() -> None:
    painter, store = Painter(), MemoryStore()
    async with server_with(store, painter, **RERUN) as server:
        client = client_of(server)
        short, long = [await client.send_goal(seconds) for seconds in (5, 1000)]
        await anyio.sleep(1)
        store.give("paint", suspect(1))
        await anyio.sleep(0.1)
        assert await ended(server, 1) == [GoalStatus.SUCCEEDED]
        assert painter.began[1] == painter.began[_number(short.goal_id)] + 1 + TRIAL
        assert long.status is GoalStatus.EXECUTING


async def test_a_suspect_that_does_not_end_lets_others_begin_after_a_while() -> None:
    painter = Painter()
    endless = suspect(1)
    endless.goal = PAINT.goal.encode(1000)
    async with server_with(store_with(endless, stored(1, 2)), painter, **RERUN) as server:
        assert await ended(server, 2) == [GoalStatus.SUCCEEDED]
    assert painter.began[2] == painter.began[1] + TRIAL


async def test_a_suspect_that_keeps_a_new_checkpoint_is_none_any_more() -> None:
    began: dict[int, float] = {}

    async def paint(goal: GoalHandle[int]) -> Painting:
        began[_number(goal.goal_id)] = current_time()
        await anyio.sleep(1)
        await goal.checkpoint(1)
        await anyio.sleep(1000)
        yield ""

    async with server_with(store_with(suspect(1), stored(1, 2)), paint, **RERUN) as server:
        await anyio.sleep(1.5)
        assert began[2] == began[1] + 1
        assert {info.reason for info in await client_of(server).goals()} == {""}


async def test_what_a_suspect_has_sent_runs_beside_it() -> None:
    """Also a goal that it has sent in an earlier attempt, as a suspect or not."""
    by_parent = {"meta": {"parent": str(id_of(1))}}
    painter = Painter()

    async def paint(goal: GoalHandle[int]) -> Painting:
        if _number(goal.goal_id) != 1:
            async for each in painter(goal):
                yield each
            return
        store.give("paint", suspect(5, **by_parent))
        await anyio.sleep(0.1)
        for number in (2, 3, 5):
            child = await client_of(server).attach(id_of(number))
            await child.outcome()
        await client_of(server).call(1)
        yield await client_of(server).call(1, step=goal.step("new"))

    goals = suspect(1), suspect(2, **by_parent), stored(1, 3, **by_parent), stored(1, 4)
    store = store_with(*goals)
    async with server_with(store, paint, **RERUN) as server:
        before = current_time()
        assert await ended(server, 1, 4) == [GoalStatus.SUCCEEDED] * 2
        assert current_time() - before < TRIAL
    assert max(painter.began, key=lambda number: painter.began[number]) == 4


async def test_a_suspect_that_is_canceled_or_whose_server_stops_lets_others_begin() -> None:
    painter, long = Painter(), Painter()
    first = server_with(store_with(suspect(1), suspect(2)), painter, **RERUN)
    async with ActionServer(PAINT, long) as busy:
        await client_of(busy).send_goal(20)
        await anyio.sleep(1)
        async with first as server:
            client = client_of(server)
            new = await client.send_goal(1)
            assert (await client.cancel_goals(id_of(1))).return_code is CancelCode.NONE
            await anyio.sleep(1)
            assert _number(new.goal_id) not in painter.began
            assert (await client.cancel_goals(id_of(2))).return_code is CancelCode.NONE
            await anyio.sleep(1)
            assert _number(new.goal_id) in painter.began
        async with server_with(store_with(suspect(1)), painter, **RERUN):
            pass
        await client_of(busy).send_goal(1)
        await anyio.sleep(1)
    assert len(long.began) == 2


async def test_the_time_for_which_a_goal_waits_for_suspects_is_not_that_of_its_run() -> None:
    painter = Painter()
    schedule = Schedule(concurrency=9, run_timeout=2)
    store = store_with(*(suspect(number) for number in (1, 2, 3, 4)))
    async with server_with(store, painter, schedule=schedule, **RERUN) as server:
        new = [await client_of(server).send_goal(seconds) for seconds in (1, 3)]
        assert await ended(server, 1, 2, 3, 4) == [GoalStatus.SUCCEEDED] * 4
        outcomes = [await goal.outcome() for goal in new]
    assert [one.status for one in outcomes] == [GoalStatus.SUCCEEDED, GoalStatus.ABORTED]
    assert outcomes[1].reason == "took longer than 2 s"


async def test_a_goal_that_waits_for_suspects_gives_way_when_it_begins() -> None:
    store = store_with(suspect(1))
    schedule = Schedule(concurrency=1, when_full="preempt", key=lambda strokes: strokes)
    async with server_with(store, Painter(), schedule=schedule, **RERUN) as server:
        client = client_of(server)
        older, newer = [await client.send_goal(5) for _ in range(2)]
        before = current_time()
        assert (await older.outcome()).reason == f"preempted by {newer.goal_id}"
        assert current_time() - before < 2
        assert await newer.result() == "attempt 1"


class NoGoals:
    """A server without goals."""

    def has_begun_others(self, goal: GoalRecord) -> bool:
        return False

    def note_suspects(self) -> None:
        pass


async def test_a_server_that_is_gone_leaves_no_suspects() -> None:
    suspects, server, begun = Suspects(), NoGoals(), anyio.Event()
    goal, other = (GoalRecord(id_of(number), b"", 1, UNKNOWN_SENDER) for number in (1, 2))
    goal.suspicion = WHY
    suspects.join(server)
    suspects.add(goal, server)
    assert not suspects.may_begin(other)
    suspects.quit(server)
    assert suspects.may_begin(other)
    await suspects.begin(goal, begun.set, lambda: False)
    assert begun.is_set()


async def test_the_next_suspect_has_its_turn_if_the_server_of_the_last_one_is_gone() -> None:
    suspects, gone, server, is_active = Suspects(), NoGoals(), NoGoals(), True
    first, second = (GoalRecord(id_of(number), b"", 1, UNKNOWN_SENDER) for number in (1, 2))
    begun: list[GoalRecord] = []
    async with anyio.create_task_group() as tasks:
        for goal, its_server in ((first, gone), (second, server)):
            goal.suspicion = WHY
            suspects.join(its_server)
            suspects.add(goal, its_server)
            tasks.start_soon(suspects.begin, goal, partial(begun.append, goal), lambda: is_active)
            await anyio.wait_all_tasks_blocked()
        assert begun == [first]
        suspects.quit(gone)
        await anyio.wait_all_tasks_blocked()  # the second one is woken first, by chance
        is_active = False
        suspects.left.notify()
    assert begun == [first, second]
