"""`GET .../stats`: what it tells, and how often it is computed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalHistory, SqliteStore, serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint
from fibaction.words.goal_query import GoalQuery
from fibaction.words.goals import GoalInfo
from fibaction_transports.web.rest import actions
from fibaction_transports.web.rest.actions import KnownStatistics
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

ACTION = "/actions/fibonacci"
HTTP = "http://127.0.0.1:0"


async def test_an_action_has_statistics_of_ten_minutes_and_of_a_span_that_the_request_names(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    server = ActionServer(FIBONACCI, fibonacci, store=store, result_timeout=0)
    with anyio.fail_after(30):
        async with serve(server, HTTP) as (url,):
            for order in (3, 5):
                await fetch(url, "POST", f"{ACTION}/goals?wait=20", {"order": order})
            day = (await fetch(url, "GET", f"{ACTION}/stats")).json
            hour = (await fetch(url, "GET", f"{ACTION}/stats?since=1h")).json
            wrong = await fetch(url, "GET", f"{ACTION}/stats?since=soon")
            assert (await fetch(url, "GET", f"{ACTION}/stats?since=")).status == 400
            other = await fetch(url, "GET", "/actions/other/stats")
            posted = await fetch(url, "POST", f"{ACTION}/stats")
    assert (day["waiting"], day["running"], day["past"]) == (0, 0, 2)
    assert day["whole"]["seconds"] == pytest.approx(86400, abs=1)
    assert hour["whole"]["seconds"] == pytest.approx(3600, abs=1)
    for span in (day["recent"], day["whole"], hour["whole"]):
        assert span["accepted"] == span["ended"]["SUCCEEDED"] == span["ran"]["count"] == 2
    assert (wrong.status, other.status, posted.status) == (400, 404, 405)
    assert wrong.json["detail"].startswith("since: 'soon' is not a time")


class Counted(ForwardingEndpoint):
    """A server whose history takes some time to read."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.read = 0

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        self.read += 1
        await anyio.lowlevel.checkpoint()


async def test_many_who_ask_at_once_get_one_computation(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(actions, "monotonic", lambda: clock[0])
    monkeypatch.setattr(actions, "MOST_KNOWN", 2)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        counted = Counted(server)
        known = KnownStatistics()
        told: list[Any] = []

        async def ask(since: str = "24h") -> None:
            told.append(await known.of(counted, since))

        async with anyio.create_task_group() as tasks:
            for _ in range(10):
                tasks.start_soon(ask)
        assert (counted.read, len(set(told))) == (1, 1)
        clock[0] += 2
        await ask()
        assert counted.read == 2
        for since in ("1h", "2h", "24h"):  # the last one was forgotten meanwhile
            await ask(since)
        assert counted.read == 5
