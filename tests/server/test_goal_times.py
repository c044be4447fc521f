"""The times of goals while the clock makes a step, as NTP sets it on a robot that has booted."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import Action, ActionServer, GoalHandle, Schedule, connect, serve
from tests.support.memory_store import MemoryStore
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

HOUR = 3600 * 10**9
WORK = Action("work", goal=int, feedback=str, result=int)


class SteppedClock:
    """A wall clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._real = time.time_ns
        self.ahead = 0
        """Nanoseconds that it is ahead of the real one."""
        monkeypatch.setattr(time, "time_ns", self.now)

    def now(self) -> int:
        return self._real() + self.ahead


@pytest.mark.parametrize("step", [HOUR, -HOUR], ids=["forward", "back"])
@pytest.mark.parametrize("is_stored", [True, False], ids=["stored", "in memory"])
async def test_a_step_of_the_clock_changes_no_duration(
    step: int, is_stored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, go_on = SteppedClock(monkeypatch), anyio.Event()

    async def work(goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
        if goal.request == 1:
            await go_on.wait()
        clock.ahead += step
        yield goal.request

    store = MemoryStore() if is_stored else None
    server = ActionServer(WORK, work, schedule=Schedule(concurrency=1, queue=1), store=store)
    async with serve(server, "http://127.0.0.1:0") as (served,), connect(served, WORK) as client:
        goals = [await client.send_goal(number) for number in (1, 2)]
        clock.ahead += step
        go_on.set()
        for goal in goals:
            await goal.result()
        infos = await client.goals()
        listed = (await fetch(str(served), "GET", "/actions/work/goals")).json
    assert len(infos) == len(listed) == 2
    told = [(one.waited, one.ran) for one in infos] + [
        (one["waited"], one["ran"]) for one in listed
    ]
    assert all(0 <= seconds < 60 for times in told for seconds in times if seconds is not None)
    assert all(None not in times for times in told)
    for kept in store.goals.values() if store else ():  # it is compared with the time of day
        assert abs(kept.ended_at - clock.now()) < HOUR * 1.5
        assert kept.keep_until > kept.ended_at
