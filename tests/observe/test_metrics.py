"""`Metrics`: what Prometheus reads of real goals, and the dashboard that shows it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    GoalID,
    GoalInfo,
    GoalKept,
    GoalRejected,
    GoalStatus,
    Schedule,
    connect,
    serve,
)
from fibaction.observe.metrics import Metrics, wants_openmetrics
from fibaction.words.errors import AuthenticationFailed
from tests.server.held import waits
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci
from tests.support.memory_store import MemoryStore
from tests.support.virtual_time import in_virtual_time

PROMTOOL = shutil.which("promtool") or shutil.which(
    "promtool", path=Path(sys.prefix) / "prometheus/usr/bin"
)
DASHBOARD = Path(__file__).parents[2] / "examples" / "grafana_dashboard.json"

asynchronous = pytest.mark.anyio


def value(metrics: Metrics, name: str, **labels: str) -> float | None:
    labels = {"action": "fibonacci", **labels}
    return metrics.registry.get_sample_value(f"fibaction_{name}", labels)


@asynchronous
async def test_goals_that_succeed_are_counted_with_their_feedback_and_their_time() -> None:
    metrics = Metrics()
    async with ActionServer(FIBONACCI, fibonacci, watchers=[metrics]) as server:
        for _ in range(2):
            await ActionClient(server, FIBONACCI).call(Goal(3))

    assert value(metrics, "goals_total", status="SUCCEEDED") == 2
    assert value(metrics, "goal_duration_seconds_count", status="SUCCEEDED") == 2
    assert value(metrics, "goal_queue_seconds_count") == 2
    assert value(metrics, "feedback_total") == 4
    assert value(metrics, "goals_active") == 0
    assert value(metrics, "goals_taken_over_total") is None


@asynchronous
async def test_goals_that_run_wait_are_rejected_and_are_canceled_are_told_apart() -> None:
    metrics = Metrics()
    schedule = Schedule(concurrency=1, queue=1)
    async with ActionServer(FIBONACCI, waits, schedule=schedule, watchers=[metrics]) as server:
        client = ActionClient(server, FIBONACCI)
        first = await client.send_goal(Goal(1))
        await anext(first.feedback)
        second = await client.send_goal(Goal(2))
        with pytest.raises(GoalRejected):
            await client.send_goal(Goal(3))
        before = value(metrics, "goals_active"), value(metrics, "goals_waiting")
        await second.cancel()
        await second.outcome()
        await first.cancel()
        await first.outcome()

    assert before == (2, 1)
    assert (value(metrics, "goals_active"), value(metrics, "goals_waiting")) == (0, 0)
    assert value(metrics, "goals_total", status="REJECTED") == 1
    assert value(metrics, "goals_total", status="CANCELED") == 2
    assert value(metrics, "cancels_total", answer="NONE") == 2


def test_a_goal_that_ends_before_it_has_begun_waits_no_longer() -> None:
    metrics, goal_id = Metrics(), GoalID.random()
    metrics.accepted("fibonacci", GoalInfo(goal_id, 1, GoalStatus.ACCEPTED), b"")
    metrics.left("fibonacci", GoalInfo(goal_id, 1, GoalStatus.ACCEPTED), "it is kept")

    assert (value(metrics, "goals_active"), value(metrics, "goals_waiting")) == (0, 0)


@asynchronous
async def test_goals_of_a_store_leave_one_server_and_are_taken_over_by_the_next() -> None:
    metrics, store = Metrics(), MemoryStore()
    options: Any = {"store": store, "recovery": "rerun", "at_stop": "keep", "watchers": [metrics]}
    async with ActionServer(FIBONACCI, waits, **options) as server:
        goal = await ActionClient(server, FIBONACCI).send_goal(Goal(4))
        await anext(goal.feedback)
    with pytest.raises(GoalKept):
        await goal.outcome()
    async with ActionServer(FIBONACCI, fibonacci, **options) as server:
        await (await ActionClient(server, FIBONACCI).attach(goal.goal_id)).outcome()

    assert value(metrics, "goals_left_total") == 1
    assert value(metrics, "goals_taken_over_total") == 1
    assert value(metrics, "goals_active") == 0


@asynchronous
async def test_feedback_that_a_follower_has_missed_is_counted() -> None:
    metrics = Metrics()
    server = ActionServer(FIBONACCI, fibonacci, feedback="latest", watchers=[metrics])
    async with server, ActionClient(server, FIBONACCI).send_goal(Goal(5)) as goal:
        await goal.outcome()
        seen = [one async for one in goal.feedback]

    assert len(seen) < 4
    assert value(metrics, "feedback_dropped_total") == 4 - len(seen)


@asynchronous
async def test_connections_are_counted_with_the_errors_that_ended_them() -> None:
    metrics = Metrics()

    def connections() -> float:
        return metrics.registry.get_sample_value("fibaction_connections") or 0

    def errors() -> float:
        labels = {"kind": "AuthenticationFailed"}
        found = metrics.registry.get_sample_value("fibaction_connection_errors_total", labels)
        return found or 0

    before = connections(), errors()
    server = ActionServer(FIBONACCI, fibonacci)
    async with serve(server, "tcp://127.0.0.1:0", tokens={"secret": "arm"}) as (url,):
        async with connect(url, FIBONACCI, token="secret") as client:
            await client.wait_for_server()
            during = connections()
            with pytest.raises(AuthenticationFailed):
                async with connect(url, token="wrong"):
                    pass
    assert during == before[0] + 1
    assert (connections(), errors()) == (before[0], before[1] + 1)


@in_virtual_time()
@asynchronous
async def test_the_lag_of_the_event_loop_is_measured() -> None:
    metrics = Metrics()
    before = metrics.beat_at
    with anyio.move_on_after(1.1):
        await metrics.run()

    assert metrics.registry.get_sample_value("fibaction_event_loop_lag_seconds_count") == 4
    assert metrics.beat_at >= before


async def text_with_all_series() -> str:
    metrics = Metrics()
    async with ActionServer(FIBONACCI, waits, watchers=[metrics]) as server:
        client = ActionClient(server, FIBONACCI)
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        await goal.cancel()
        await goal.outcome()
    return metrics.text().decode()


@asynchronous
async def test_the_dashboard_shows_series_that_exist() -> None:
    text = await text_with_all_series()
    names = set(re.findall(r"^# TYPE (\w+) ", text, re.MULTILINE))
    dashboard = json.loads(DASHBOARD.read_text())
    used = set(re.findall(r"fibaction_\w+", json.dumps(dashboard["panels"])))

    assert {name.removesuffix("_bucket") for name in used} == {
        name for name in names if not name.endswith("_created")
    }


@asynchronous
@pytest.mark.skipif(PROMTOOL is None, reason="there is no promtool, and `make unit` got none")
async def test_promtool_finds_nothing_to_say_about_the_series() -> None:
    text = await text_with_all_series()
    checked = await anyio.to_thread.run_sync(
        lambda: subprocess.run(
            [str(PROMTOOL), "check", "metrics"],
            input=text,
            capture_output=True,
            text=True,
            timeout=30,
        )
    )

    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")


# The format that a request asks for, by the headers of programs that are about


PROMETHEUS = (
    "application/openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.6,"
    "application/openmetrics-text;version=0.0.1;q=0.5,text/plain;version=1.0.0;q=0.4,"
    "text/plain;version=0.0.4;q=0.3,*/*;q=0.2"
)


@pytest.mark.parametrize(
    "accept",
    [
        PROMETHEUS,
        "application/openmetrics-text",
        'Application/OpenMetrics-Text; Version="1.0.0"',
        "text/plain;q=0.5, application/openmetrics-text",
        "text/plain, application/openmetrics-text",
    ],
)
def test_a_request_that_names_openmetrics_gets_it(accept: str) -> None:
    assert wants_openmetrics(accept)


def test_every_other_request_gets_the_format_of_prometheus() -> None:
    accepts = [
        *("", "*/*", ";;,=,", "text/plain;version=0.0.4"),
        "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8",
        "application/openmetrics-text;q=0.3, text/plain;q=0.5",
        "application/openmetrics-text;version=0.0.1",
        *(f"application/openmetrics-text;q={quality}" for quality in ("0", "high", "nan", "2")),
    ]
    assert [accept for accept in accepts if wants_openmetrics(accept)] == []
