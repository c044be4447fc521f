"""The goals of a fleet that were given up."""

from __future__ import annotations

import time
from functools import partial

import pytest
from anyio import sleep

from fibaction import ConnectionLost, GoalStatus, StoreError
from fibaction.border.goal_store import StoredGoal
from fibaction_transports.nats.history.fleet_history import FleetHistory
from fibaction_transports.nats.history.given_up import given_up_goals, rerun_goal
from fibaction_transports.nats.worker.record_writes import SECOND
from tests.support.memory_broker import MemoryBrokers
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.members import LEASE, NAMES, entry, goal, keep, member

pytestmark = [pytest.mark.anyio, in_virtual_time()]


def given_up(number: int = 1, **fields: object) -> StoredGoal:
    """Return a goal that was given up as the number-th one."""
    changes: dict[str, object] = {"status": GoalStatus.ABORTED, "is_running": False}
    changes |= {"ended_at": number, "reason": "given up", "checkpoint": b"half", **fields}
    return goal(number, **changes)


async def test_they_are_listed_in_the_order_of_their_ends() -> None:
    async with MemoryBrokers() as shared:
        for number in (3, 1, 2):
            keep(shared, given_up(number))
        keep(shared, goal(4))
        keep(shared, given_up(5, goal=b""))
        shared.put(NAMES.goal("count", goal(6).goal_id), b"", 0, 60)
        found = await given_up_goals(shared.member(), NAMES)
        assert found == {"count": [given_up(1), given_up(2), given_up(3)]}


async def test_one_runs_again_once_as_a_new_goal_from_its_checkpoint() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        until = time.time_ns() + 100 * SECOND
        keep(shared, given_up(keep_until=until))
        rerun = partial(rerun_goal, shared.member(), NAMES)
        new = await rerun("count", given_up().goal_id)
        (claimed,) = await a.claims(1, within=1)
        assert claimed.goal_id == new != given_up().goal_id
        assert (claimed.goal, claimed.checkpoint) == (b"goal", b"half")
        assert (claimed.attempt, claimed.is_running) == (0, False)
        old = entry(shared, given_up()).goal
        assert (old.status, old.reason, old.keep_until) == (GoalStatus.ABORTED, "given up", until)
        assert not old.is_given_up
        with pytest.raises(StoreError, match="was not given up, or is not kept any more"):
            await rerun("count", given_up().goal_id)


async def test_what_was_not_given_up_does_not_run_again() -> None:
    async with MemoryBrokers() as shared:
        rerun = partial(rerun_goal, shared.member(), NAMES)
        with pytest.raises(StoreError, match="was not given up, or is not kept any more"):
            await rerun("count", goal().goal_id)
        keep(shared, given_up())
        keep(shared, given_up().as_new(1))
        with pytest.raises(StoreError, match="runs again already, as goal "):
            await rerun("count", given_up().goal_id)
        shared.is_full = True
        keep_again = given_up(2)
        shared.is_full = False
        keep(shared, keep_again)
        shared.is_full = True
        with pytest.raises(StoreError, match="cannot be run again: "):
            await rerun("count", keep_again.goal_id)


async def test_an_endpoint_and_a_worker_run_one_again_or_tell_that_it_was_not_given_up() -> None:
    async with MemoryBrokers() as shared, member(shared, "a") as a:
        keep(shared, given_up())
        history = FleetHistory(shared.member(), NAMES, "count")
        new = await history.rerun(given_up().goal_id)
        (claimed,) = await a.claims(1, within=1)
        assert claimed.goal_id == new
        assert await history.rerun(given_up().goal_id) is None


async def test_brokers_that_are_away_are_an_error() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        broker.is_away = True
        rerun = partial(rerun_goal, broker, NAMES)
        with pytest.raises(ConnectionLost, match="the goals of the fleet cannot be listed: "):
            await given_up_goals(broker, NAMES)
        with pytest.raises(StoreError, match="cannot be read"):
            await FleetHistory(broker, NAMES, "count").rerun(goal().goal_id)
        with pytest.raises(ConnectionLost, match="the record of goal 0101"):
            await rerun("count", given_up().goal_id)


async def test_a_fleet_keeps_so_many_of_them_also_over_restarts_of_its_workers() -> None:
    async with MemoryBrokers() as shared:
        for number in range(1, 12):
            keep(shared, given_up(number))
        async with member(shared, "a") as a:  # it keeps nine
            await sleep(1)
            kept = [one.stamp for one in (await given_up_goals(a.broker, NAMES))["count"]]
            assert kept == list(range(3, 12))
            a.accept(goal(20), goal(21))
            a.journal.end(given_up(20), lambda _error: None)
            a.journal.end(given_up(21, goal=b""), lambda _error: None)
            await sleep(LEASE)
            kept = [one.stamp for one in (await given_up_goals(a.broker, NAMES))["count"]]
            assert kept == [*range(4, 12), 20]


async def test_one_is_read_with_its_checkpoint_as_long_as_it_can_run_again() -> None:
    async with MemoryBrokers() as shared, member(shared, "a"):
        keep(shared, given_up())
        keep(shared, goal(2))
        history = FleetHistory(shared.member(), NAMES, "count")
        found = await history.given_up(given_up().goal_id)
        assert found is not None
        assert found.checkpoint == b"half"
        for number in (2, 3):
            assert await history.given_up(goal(number).goal_id) is None
        await history.rerun(given_up().goal_id)
        assert await history.given_up(given_up().goal_id) is None
        shared.put(NAMES.goal("count", goal(6).goal_id), b"of a later version", 0, 60)
        with pytest.raises(StoreError, match="cannot be read"):
            await history.given_up(goal(6).goal_id)
