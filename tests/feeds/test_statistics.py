"""`fibaction.feeds.statistics`: counts, reasons and percentiles in bounded memory."""

from __future__ import annotations

import math
import time
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    GoalID,
    GoalInfo,
    GoalStatus,
    SqliteStore,
    connect,
    serve,
)
from fibaction.feeds import statistics as module
from fibaction.feeds.statistics import Durations, FailedGoals, GoalStatistics, statistics_of

SECOND = 10**9
NOW = 1_800_000_000 * SECOND
DAY = 24 * 3600


def ended(ago: float, waited: float, ran: float, **fields: Any) -> GoalInfo:
    """A goal that ended so many seconds ago."""
    end = NOW - int(ago * SECOND)
    began = end - int(ran * SECOND)
    fields = {"status": GoalStatus.SUCCEEDED, **fields}
    stamp = began - int(waited * SECOND)
    return GoalInfo(GoalID.random(), stamp, began_at=began, ended_at=end, **fields)


@given(st.lists(st.floats(0, 1e9), min_size=1, max_size=300))
def test_a_percentile_is_that_of_the_sorted_durations_but_for_one_percent(
    seconds: list[float],
) -> None:
    durations = Durations()
    for one in seconds:
        durations.add(one)
    told = durations.told()
    assert told is not None
    assert (told.count, told.most) == (len(seconds), max(seconds))
    for share, found in ((0.5, told.p50), (0.95, told.p95)):
        exact = sorted(seconds)[math.ceil(share * len(seconds)) - 1]
        assert found == pytest.approx(exact, rel=0.0101, abs=1.1e-6)


def test_an_end_counts_when_it_was_and_an_acceptance_when_it_was() -> None:
    statistics = GoalStatistics(NOW, NOW - DAY * SECOND)
    statistics.add(ended(10, 1, 4), is_past=True)
    statistics.add(ended(1000, 3, 8), is_past=True)
    statistics.add(ended(10, 0, 2 * 3600, status=GoalStatus.CANCELED))
    statistics.add(ended(DAY + 1, 0, 5))
    statistics.add(GoalInfo(GoalID.random(), NOW - 2 * SECOND, GoalStatus.ACCEPTED))
    statistics.add(GoalInfo(GoalID.random(), NOW - 2 * DAY * SECOND, GoalStatus.EXECUTING))

    told = statistics.told()
    assert statistics.earliest == NOW - 2 * DAY * SECOND
    assert (told.waiting, told.running, told.past) == (1, 1, 2)
    assert (told.recent.seconds, told.whole.seconds) == (600, DAY)
    assert told.recent.ended == {"SUCCEEDED": 1, "CANCELED": 1, "ABORTED": 0}
    assert told.whole.ended == {"SUCCEEDED": 2, "CANCELED": 1, "ABORTED": 0}
    assert (told.recent.accepted, told.recent.per_minute) == (2, 0.2)
    assert told.whole.accepted == 4
    assert told.whole.waited is not None
    assert (told.whole.waited.count, told.whole.waited.most) == (3, 3)
    assert told.whole.ran is not None
    assert told.whole.ran.p95 == pytest.approx(7200, rel=0.01)


def test_what_is_not_known_of_a_goal_is_not_counted() -> None:
    statistics = GoalStatistics(NOW, NOW + SECOND)  # an empty span has a second
    statistics.add(GoalInfo(GoalID.random(), NOW, GoalStatus.SUCCEEDED))  # as ROS tells it
    told = statistics.told().whole
    assert (told.seconds, told.ended["SUCCEEDED"], told.waited, told.ran) == (1, 1, None, None)


def test_reasons_are_counted_up_to_a_number_and_the_rest_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MOST_REASONS", 3)
    monkeypatch.setattr(module, "MOST_TOLD", 2)
    statistics = GoalStatistics(NOW, NOW - 60 * SECOND)
    for reason in ("hot", "stuck", "hot", "", "new", "newer"):
        statistics.add(ended(1, 0, 1, status=GoalStatus.ABORTED, reason=reason))
    told = [(one.reason, one.goals) for one in statistics.told().whole.failures]
    assert told == [("hot", 2), ("stuck", 1), ("other reasons", 3)]


PAINT = Action("paint", goal=int, feedback=int, result=str)


async def paint(goal: GoalHandle[int]) -> AsyncGenerator[str, None]:
    if goal.request == 0:
        raise GoalAborted("nothing to paint")
    yield "painted"


async def ran(client: ActionClient[int, int, str], request: int) -> None:
    async with client.send_goal(request) as goal:
        await goal.outcome()


@pytest.mark.anyio
@pytest.mark.parametrize("forgotten", [True, False])
async def test_statistics_have_each_goal_once_whether_it_is_remembered_or_not(
    tmp_path: Path, forgotten: bool
) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    timeout = 0 if forgotten else 60
    with anyio.fail_after(30):
        async with (
            ActionServer(PAINT, paint, store=store, result_timeout=timeout) as server,
            serve(server, "tcp://127.0.0.1:0") as (url,),
            connect(url, PAINT) as client,
        ):
            for request in (3, 0, 1, 0, 2):
                await ran(client, request)
            for endpoint in (server, client.endpoint):
                told = await statistics_of(endpoint, time.time_ns() - 60 * 10**9)
                assert told.past == (5 if forgotten else 0)
                assert told.whole.ended == {"SUCCEEDED": 3, "CANCELED": 0, "ABORTED": 2}
                assert told.whole.failures == (FailedGoals("nothing to paint", 2),)
                assert told.whole.ran is not None
                assert told.whole.ran.count == 5
