"""Actions by REST: how they take goals, told and changed, and their statistics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import (
    ActionServer,
    GoalHistory,
    Permission,
    ServerNotFound,
    SqliteStore,
    connect,
    serve,
)
from fibaction.border.abc import Endpoint, ForwardingEndpoint, Intake, IntakeChange
from fibaction.border.http_access import Refused
from fibaction.words.goal_query import GoalQuery
from fibaction.words.goals import GoalInfo
from fibaction.words.intake import NO_LEVERS
from fibaction_transports.web.rest import actions
from fibaction_transports.web.rest.actions import KnownStatistics, wanted_in
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import HTTP, fetch, permitting, served

pytestmark = pytest.mark.anyio

ACTION = "/actions/fibonacci"


async def test_an_action_is_paused_and_resumed_and_its_list_tells_it_also_at_a_bridge() -> None:
    with anyio.fail_after(30):
        async with (
            serve(new_server(), "tcp://127.0.0.1:0") as (robot,),
            connect(robot) as there,
            serve(there.endpoint(FIBONACCI), HTTP) as (url,),
        ):
            assert "intake" not in (await fetch(url, "GET", "/actions")).json[0]
            pause = {"mode": "refuse", "reason": "wet floor"}
            paused = (await fetch(url, "PUT", f"{ACTION}/intake", pause)).json
            assert paused == (await fetch(url, "GET", f"{ACTION}/intake")).json
            for path in ("/actions", ACTION):
                listed = (await fetch(url, "GET", path)).json
                told = (listed[0] if path == "/actions" else listed)["intake"]
                assert told["mode"] == "refuse"
                assert told["text"].endswith(": wet floor")
            rejected = await fetch(url, "POST", f"{ACTION}/goals", {"order": 3})
            assert (rejected.status, rejected.headers["retry-after"]) == (503, "1")
            assert (rejected.json["code"], "wet floor" in rejected.json["detail"]) == ("BUSY", True)
            await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "open"})
            answer = await fetch(url, "POST", f"{ACTION}/goals?wait=20", {"order": 3})
            assert answer.json["status"] == "SUCCEEDED"
            worker = {"mode": "drain", "worker": "arm-1"}
            refused = await fetch(url, "PUT", f"{ACTION}/intake", worker)
            assert (refused.status, "has no workers" in refused.json["detail"]) == (409, True)
    [change] = paused["changes"]
    assert (change["mode"], change["reason"]) == ("refuse", "wet floor")
    assert ", for 127.0.0.1:" in change["by"]


async def test_who_may_not_operate_is_refused() -> None:
    async with served(authorize=permitting([Permission.OBSERVE])) as url:
        answer = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert answer.status == 403
        told = (await fetch(url, "GET", f"{ACTION}/intake")).json
        assert (told["mode"], told["changes"], told["has_levers"]) == ("open", [], True)


@pytest.mark.parametrize("body", [b"", b"[]", b'{"mode": "stop"}', b'{"mode": "hold", "x": 1}'])
def test_what_is_not_a_change_is_refused(body: bytes) -> None:
    with pytest.raises(Refused, match="a change has a mode, and may have a reason"):
        wanted_in(body)


async def test_a_server_that_is_away_is_not_a_lever_that_is_missing() -> None:
    class Away(ForwardingEndpoint):
        async def change_intake(self, change: IntakeChange) -> Intake:
            raise ServerNotFound("no answer")

    async with new_server() as server, served(Away(server)) as url:
        answer = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert (answer.status, answer.headers["retry-after"]) == (503, "1")


async def test_only_who_may_observe_learns_who_has_paused_an_action_and_its_schedule() -> None:
    may = {Permission.OBSERVE, Permission.OPERATE}

    async with served(authorize=permitting(may)) as url:
        await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold", "reason": "wet floor"})
        [seen] = (await fetch(url, "GET", "/actions")).json
        assert " by 127.0.0.1:" in seen["intake"]["text"]
        assert seen["schedule"] == {"text": "all goals run at once", "max_goals": 20000}
        assert "no_levers" not in seen
        may.remove(Permission.OBSERVE)
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["intake"]["mode"] == "hold"
        assert listed["intake"]["text"].endswith(":00: wet floor")
        assert "127.0.0.1" not in listed["intake"]["text"]
        assert "schedule" not in listed


async def test_an_action_that_cannot_be_paused_says_so_in_its_list_and_refuses_the_lever() -> None:
    class Fixed(ForwardingEndpoint):
        intake = Endpoint.intake
        change_intake = Endpoint.change_intake

    async with new_server() as server, served(Fixed(server)) as url:
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["no_levers"] == NO_LEVERS
        refused = await fetch(url, "PUT", f"{ACTION}/intake", {"mode": "hold"})
        assert refused.status == 409
        assert refused.json["detail"] == f"the action 'fibonacci' stays as it is: {NO_LEVERS}"


async def test_an_action_that_does_not_tell_how_it_takes_goals_is_listed_all_the_same() -> None:
    class Silent(ForwardingEndpoint):
        async def intake(self) -> Intake:
            raise ServerNotFound("no answer")

    async with new_server() as server, served(Silent(server)) as url:
        [listed] = (await fetch(url, "GET", "/actions")).json
        assert listed["name"] == "fibonacci"
        assert not listed.keys() & {"away", "intake", "no_levers", "schedule"}


async def test_an_action_has_statistics_of_ten_minutes_and_of_a_span_that_the_request_names(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    server = ActionServer(FIBONACCI, fibonacci, store=store, result_timeout=0)
    async with served(server) as url:
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
