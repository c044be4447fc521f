"""The history of a fleet on a real nats-server: its bounds, its pages, and what survives."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    TransportError,
    connect,
    serve,
)
from fibaction.words.goal_query import GoalHistory, GoalQuery, PastPage
from fibaction_transports.nats.broker import jetstream
from fibaction_transports.nats.broker.broker import PutError, PutFailure
from fibaction_transports.nats.broker.nats_broker import NatsBroker, open_broker
from fibaction_transports.nats.names import FleetNames
from tests.fleet.workers import Setup, workers
from tests.kills.victim import WORK, Work
from tests.support.nats_server import NatsServer
from tests.support.processes import PATIENCE
from tests.transports.nats.test_broker_rules import first_of, settings_of
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio
COUNT = Action("count", goal=int, feedback=int, result=str)
HOUR = 3600 * 10**9


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.request < 0:
        await anyio.sleep_forever()
    for number in range(goal.request):
        yield number
    yield str(goal.request)


def server() -> ActionServer[int, int, str]:
    return ActionServer(COUNT, count, result_timeout=0)


async def pages_of(
    client: ActionClient[Any, Any, Any],
    number: int,
    limit: int = 1000,
    wanted: GoalQuery | None = None,
) -> list[GoalInfo]:
    """Return the goals of the history in pages, as soon as there are so many."""
    with anyio.fail_after(PATIENCE):
        while True:
            found: list[GoalInfo] = []
            page = PastPage(wanted or GoalQuery(), limit)
            while part := await client.endpoint.past_goals(page):
                found += part
                page = page._replace(after=(part[-1].stamp, bytes(part[-1].goal_id)))
            if len(found) == number:
                return found
            await anyio.sleep(0.05)


@pytest.mark.promise("FLEET-13")
async def test_goals_of_all_workers_are_in_the_history_with_what_a_list_tells(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    query = "history_days=30"
    async with (
        serve(server(), f"{url}?worker=a&{query}"),
        serve(server(), f"{url}?worker=b&{query}"),
    ):
        for worker in "ab":
            async with connect(f"{url}?worker={worker}", COUNT) as client:
                await client.call(2, labels={"at": worker})
                assert len(await client.endpoint.past_goals(PastPage())) <= 2
    async with connect(url, COUNT) as client:  # no worker lives
        of_b, of_a = await pages_of(client, 2)
        labeled = GoalQuery(frozenset({GoalStatus.SUCCEEDED}), since=0, labels=(("at", "a"),))
        assert await pages_of(client, 1, wanted=labeled) == [of_a]
        followed = await client.attach(of_a.goal_id)
        assert (await followed.outcome()).result == "2"
        assert followed.feedback.stream.info == of_a
    assert (of_a.worker, of_b.worker, of_a.labels) == ("a", "b", {"at": "a"})
    assert (of_a.feedback_count, of_a.status) == (2, GoalStatus.SUCCEEDED)
    assert of_a.waited is not None
    assert of_a.ran is not None


@pytest.mark.promise("FLEET-13")
async def test_a_bridge_and_a_worker_tell_the_history_over_rest(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    async with (
        serve(server(), f"{url}?worker=a&history_days=1", "http://127.0.0.1:0") as (_, of_worker),
        connect(url) as connection,
        serve(connection.endpoint(COUNT), "http://127.0.0.1:0") as (of_bridge,),
    ):
        client = connection.client(COUNT)
        for number in range(3):
            await client.call(number, labels={"number": str(number)})
        infos = await pages_of(client, 3)
        for door in (of_bridge, of_worker):
            first = await fetch(door, "GET", "/actions/count/goals?past=true&limit=2")
            assert 'rel="next"' in first.headers["link"]
            two = await fetch(door, "GET", "/actions/count/goals?past=true&label=number=2")
            assert [one["goal_id"] for one in two.json] == [str(infos[0].goal_id)]
            one = await fetch(door, "GET", f"/actions/count/goals/{infos[0].goal_id}")
            assert (one.json["result"], one.json["labels"]) == ("2", {"number": "2"})
            assert [one["stamp"] for one in first.json] == [str(one.stamp) for one in infos[:0:-1]]


async def test_heads_are_told_since_a_time(shared_broker: NatsServer, fleet: str) -> None:
    names = FleetNames(fleet)
    async with open_broker(settings_of(shared_broker, fleet)) as broker:
        await broker.create_streams(names, history=GoalHistory())
        stored: list[int | PutError] = []
        for _ in range(2):
            subject = names.past("count", GoalID(bytes(16)), 7)
            broker.put(subject, b"data", expected=0, head=b"head", then=stored.append)
        await broker.flush()
        heads: list[list[bytes]] = []
        for since in (0, time.time_ns() - HOUR, time.time_ns() + HOUR):
            async with broker.watch(names.history, names.past("count"), heads_since=since) as watch:
                heads.append([record.data for record in await first_of(watch)])
    assert heads == [[b"head"], [b"head"], []]
    first, second = stored
    assert isinstance(first, int)
    assert isinstance(second, PutError)
    assert second.kind is PutFailure.REFUSED


@pytest.mark.promise("FLEET-13")
async def test_many_goals_come_in_pages_and_the_oldest_are_removed(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    async with serve(server(), f"{url}?history_goals=40"), connect(url, COUNT) as client:
        sent = [await client.send_goal(1) for _ in range(60)]
        for goal in sent:
            await goal.result()
        found = await pages_of(client, 40, limit=7)
        newest = await client.call(2)
        again = [info for info in await pages_of(client, 40) if info not in found]
    assert newest == "2"
    assert len(again) == 1
    assert len({info.goal_id for info in found}) == 40
    assert found == sorted(found, key=lambda info: info.stamp, reverse=True)


@pytest.mark.promise("FLEET-13")
async def test_goals_are_removed_after_their_time(shared_broker: NatsServer, fleet: str) -> None:
    url = shared_broker.url(fleet)
    seconds = 2.0
    async with serve(server(), f"{url}?history_days={seconds / 86400}"):
        async with connect(url, COUNT) as client:
            await client.call(1)
            await pages_of(client, 1)
            await pages_of(client, 0)


@pytest.mark.promise("FLEET-13")
async def test_the_history_survives_the_kill_of_the_broker(
    own_broker: NatsServer, fleet: str
) -> None:
    url = own_broker.url(fleet)
    async with serve(server(), f"{url}?history_days=1"), connect(url, COUNT) as client:
        await client.call(1)
        [first] = await pages_of(client, 1)
        own_broker.kill()
        own_broker.start()
        with anyio.fail_after(PATIENCE):
            await client.call(2)
        second, again = await pages_of(client, 2)
    assert again == first
    assert second.stamp > first.stamp


@pytest.mark.promise("FLEET-13")
async def test_the_goal_of_a_worker_that_is_killed_is_in_the_history_with_its_end(
    shared_broker: NatsServer, fleet: str, tmp_path: Path
) -> None:
    url = shared_broker.url(fleet)

    def setup(name: str) -> Setup:
        own = f"{url}?worker={name}&lease=2&history_days=1"
        return Setup(name, own, str(tmp_path / name), "abort")

    async with workers(setup("a"), setup("b")) as (a, b), connect(url, WORK) as client:
        by_name = {"a": a, "b": b}
        goal = await client.send_goal(Work(1, 1000.0))
        [info] = await client.goals()
        by_name[info.worker].kill()
        with anyio.fail_after(PATIENCE):
            outcome = await goal.outcome()
        [past] = await pages_of(client, 1)
    assert outcome.status is past.status is GoalStatus.ABORTED
    assert (past.goal_id, past.reason) == (goal.goal_id, outcome.reason)
    assert past.worker in by_name.keys() - {info.worker}


@pytest.mark.promise("FLEET-13")
async def test_the_goal_of_a_client_that_is_killed_is_in_the_history(
    shared_broker: NatsServer, fleet: str
) -> None:
    url = shared_broker.url(fleet)
    query = "?history_days=1&orphans=cancel&grace=0.5&heartbeat=0.5"
    async with serve(server(), f"{url}{query}"), connect(url, COUNT) as client:
        sending = [sys.executable, "-m", "fibaction", "send_goal", "-u", url]
        sending += ["--label", "order=17", "count", "--", "-1"]
        async with (
            client.events() as events,
            await anyio.open_process(sending, stdout=None, stderr=None) as process,
        ):
            with anyio.fail_after(PATIENCE):
                begun = await anext(events)
            process.kill()
        [past] = await pages_of(client, 1)
    assert (past.goal_id, past.status) == (begun.goal_id, GoalStatus.CANCELED)
    assert past.labels == {"order": "17"}


# The stream


async def config_of(broker: NatsBroker, names: FleetNames) -> dict[str, Any]:
    answer = await jetstream.call(broker, f"STREAM.INFO.{names.history}")
    config: dict[str, Any] = answer["config"]
    return config


async def test_the_bounds_of_the_worker_that_joined_last_hold(
    shared_broker: NatsServer, fleet: str
) -> None:
    names = FleetNames(fleet)
    async with open_broker(settings_of(shared_broker, fleet)) as broker:
        for history in (GoalHistory(), GoalHistory(seconds=60, goals=7)):
            await broker.create_streams(names, history=history)
        found = await config_of(broker, names)
        assert (found["max_age"], found["max_msgs"]) == (60 * jetstream.SECOND, 7)
        assert found["max_bytes"] == jetstream.HISTORY_BYTES
        await broker.create_streams(names, history=GoalHistory(seconds=math.inf))
        found = await config_of(broker, names)
        assert (found.get("max_age", 0), found["discard"]) == (0, "old")
        too_many = GoalHistory(goals=2**70)
        await broker.create_streams(names, history=too_many)


async def test_bounds_that_cannot_be_set_are_one_sentence(
    shared_broker: NatsServer, fleet: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = FleetNames(fleet)

    async def fail(*_: object) -> None:
        raise jetstream.ApiError({"description": "not now"})

    async with open_broker(settings_of(shared_broker, fleet)) as broker:
        await broker.create_streams(names, history=GoalHistory())
        monkeypatch.setattr(jetstream, "update_stream", fail)
        with pytest.raises(TransportError, match="HISTORY cannot be set: not now"):
            await broker.create_streams(names, history=GoalHistory(goals=1))
