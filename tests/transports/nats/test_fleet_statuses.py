"""The statuses of the goals of a fleet, which come from their records."""

from __future__ import annotations

from typing import Any, cast

import anyio
import pytest

from fibaction import ConnectionLost, GoalID, GoalStatus, Schedule
from fibaction.border.abc import Endpoint, ForwardingEndpoint, StatusStream
from fibaction.words.goals import Sender
from fibaction_transports.nats.client import statuses as statuses_module
from fibaction_transports.nats.client.statuses import steps
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
    ENDED,
    GOAL_ID,
    NAMES,
    FakeFleet,
    FakeWorker,
    client_of,
    server,
)
from tests.wire.memory import settled

pytestmark = [pytest.mark.anyio, in_virtual_time()]

SUBJECT = NAMES.goal("count", GOAL_ID)


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


async def next_of(statuses: StatusStream, count: int) -> list[str]:
    """The next statuses, and no more."""
    found = []
    for _ in range(count):
        with anyio.fail_after(30):
            info = await statuses.receive()
        assert info is not None
        found.append(info.status.name)
    return found


@pytest.mark.parametrize(
    ("before", "after", "has_begun", "told"),
    [
        (None, "ACCEPTED", False, "ACCEPTED"),
        (None, "EXECUTING", True, "ACCEPTED EXECUTING"),
        (None, "SUCCEEDED", True, "ACCEPTED EXECUTING SUCCEEDED"),
        (None, "ABORTED", False, "ACCEPTED EXECUTING ABORTED"),
        (None, "CANCELED", False, "ACCEPTED CANCELING CANCELED"),
        (None, "CANCELED", True, "ACCEPTED EXECUTING CANCELING CANCELED"),
        ("ACCEPTED", "CANCELING", True, "EXECUTING CANCELING"),
        ("EXECUTING", "CANCELED", True, "CANCELING CANCELED"),
        ("CANCELING", "SUCCEEDED", True, "SUCCEEDED"),
        ("EXECUTING", "EXECUTING", True, ""),
        ("SUCCEEDED", "EXECUTING", True, ""),
    ],
)
async def test_overwritten_statuses_are_filled_in(
    before: str | None, after: str, has_begun: bool, told: str
) -> None:
    first = None if before is None else GoalStatus[before]
    found = steps(first, GoalStatus[after], has_begun=has_begun)
    assert " ".join(step.name for step in found) == told


async def test_goals_are_told_as_they_are_and_then_as_they_change(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        await client.call(3)
        with await client.endpoint.status() as statuses:
            assert (statuses.known, statuses.dropped) == (1, 0)
            assert await next_of(statuses, 1) == ["SUCCEEDED"]
            await client.call(3)
            assert await next_of(statuses, 3) == ["ACCEPTED", "EXECUTING", "SUCCEEDED"]
            a.own(GOAL_ID, **ENDED)
            assert await next_of(statuses, 3) == ["ACCEPTED", "EXECUTING", "SUCCEEDED"]
            fleet.broker.store(SUBJECT, b"")
            assert await next_of(statuses, 1) == ["UNKNOWN"]
            for data in (b"", b"?"):
                fleet.broker.store(SUBJECT, data)
                await settled()
            a.own(GOAL_ID)
            assert await next_of(statuses, 2) == ["ACCEPTED", "EXECUTING"]


async def test_ended_goals_come_first_and_all_that_is_known_is_told(fleet: FakeFleet) -> None:
    gone = FakeWorker(fleet.broker, "gone")
    other = GoalID(bytes(16)[:15] + b"\1")
    gone.own(other, stamp=9, attempt=2)
    gone.own(GOAL_ID, **ENDED)
    async with fleet.connect() as connection:
        ended, active = await client_of(connection).goals()
        assert (ended.goal_id, ended.feedback_count) == (GOAL_ID, 3)
        assert (active.goal_id, active.stamp, active.attempt) == (other, 9, 2)
        assert active.client == str(Sender())
        assert (ended.has_worker, active.has_worker) == (True, False)
        assert (ended.worker, active.worker) == ("gone", "gone")


async def test_a_goal_has_a_worker_as_long_as_that_lives(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        a.own(GOAL_ID)
        assert [one.has_worker for one in await client.goals()] == [True]
        a.incarnation = b"another"
        a.renew()
        await settled()
        assert [one.has_worker for one in await client.goals()] == [False]


async def test_all_followers_share_one_watch(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        client = client_of(connection)
        with await client.endpoint.status() as one:
            watches = fleet.broker.watches
            await client.call(3)
            with await client.endpoint.status() as other:
                assert other.known == 1
                assert fleet.broker.watches == watches + 1  # for a list, which ends
                await client.call(3)
                assert await next_of(other, 4) == [
                    "SUCCEEDED",
                    "ACCEPTED",
                    "EXECUTING",
                    "SUCCEEDED",
                ]
            assert await next_of(one, 6) == ["ACCEPTED", "EXECUTING", "SUCCEEDED"] * 2


async def test_a_follower_knows_what_the_watch_has_not_told_yet(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        with await client.endpoint.status():
            fleet.broker.watch_delay = 9.0
            a.own(GOAL_ID)
            assert [info.goal_id for info in await client.goals()] == [GOAL_ID]


async def test_what_was_forgotten_while_the_watch_was_interrupted_is_told(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        a.own(GOAL_ID)
        with await client.endpoint.status() as statuses:
            assert await next_of(statuses, 1) == ["EXECUTING"]
            fleet.broker.begin_anew()
            await settled()
            del fleet.broker.shared.records[SUBJECT]
            fleet.broker.begin_anew()
            assert await next_of(statuses, 1) == ["UNKNOWN"]


async def test_places_of_waiting_goals_are_asked_of_their_workers(fleet: FakeFleet) -> None:
    schedule = Schedule(concurrency=1, queue=5)
    gone = FakeWorker(fleet.broker, "gone")
    gone.own(GOAL_ID, attempt=0)
    async with fleet.worker("a").serve(server(schedule=schedule)), fleet.connect() as connection:
        client = client_of(connection)
        goals = [await client.send_goal(-1) for _ in range(3)]
        places = {info.goal_id: (info.place, info.queue_length) for info in await client.goals()}
        assert [places[goal.goal_id] for goal in goals] == [(0, 0), (1, 2), (2, 2)]
        assert places[GOAL_ID] == (0, 0)


async def test_places_that_a_worker_does_not_tell_are_left_out(
    fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        a.own(GOAL_ID, attempt=0)
        a.hang_up()
        monkeypatch.setattr(statuses_module, "PLACES_TIMEOUT", 0.5)
        assert [info.place for info in await client.goals()] == [0]


async def test_brokers_that_are_away_delay_the_statuses(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        client = client_of(connection)
        await connection.actions()
        fleet.broker.is_away = True
        with pytest.raises(ConnectionLost, match="have not told the goals of the fleet in time"):
            await client.goals()
        async with anyio.create_task_group() as tasks:

            async def come_back() -> None:
                await anyio.sleep(1)
                fleet.broker.is_away = False

            tasks.start_soon(come_back)
            a.own(GOAL_ID)
            with await client.endpoint.status() as statuses:
                assert statuses.known == 1
                fleet.broker.is_away = True
                with pytest.raises(ConnectionLost, match="cannot be listed: the brokers"):
                    await client.goals()


class Followed(ForwardingEndpoint):
    """A gateway that keeps the streams of those who follow its goals."""

    def __init__(self, inner: Endpoint) -> None:
        super().__init__(inner)
        self.streams: list[Any] = []

    async def status(self) -> StatusStream:
        self.streams.append(await super().status())
        return cast("StatusStream", self.streams[-1])


async def test_goals_of_a_gateway_are_told_as_long_as_they_are_followed(fleet: FakeFleet) -> None:
    gateway = Followed(server())
    async with fleet.worker("g", is_kept=False).serve(gateway), fleet.connect() as connection:
        client = client_of(connection)
        for known in (0, 2):
            with await client.endpoint.status() as statuses:
                assert statuses.known == known
                told = ["SUCCEEDED"] * known
                for number in (1, 2):
                    await client.call(3)
                    told += ["ACCEPTED", "EXECUTING", "SUCCEEDED"]
                    assert await next_of(statuses, len(told)) == told
                    assert len(await client.goals()) == known + number
                    told.clear()
            await settled()
            assert gateway.streams[-1]._end is not None, "it is closed"
    assert len(gateway.streams) == 2, "one for all who follow at the same time"


async def test_a_gateway_that_comes_back_is_followed_again(fleet: FakeFleet) -> None:
    async with fleet.connect() as connection:
        client = client_of(connection)
        async with fleet.worker("g", is_kept=False).serve(server()) as g:
            statuses = await client.endpoint.status()
            g.die()
            await settled()
        async with fleet.worker("g", is_kept=False).serve(server()):
            await settled()
            await client.goals()
            await client.call(3)
            assert await next_of(statuses, 3) == ["ACCEPTED", "EXECUTING", "SUCCEEDED"]
        statuses.close()


async def test_a_place_of_a_goal_that_has_begun_by_its_record_is_left_out(
    fleet: FakeFleet,
) -> None:
    schedule = Schedule(concurrency=1, queue=5)
    async with (
        fleet.worker("a").serve(server(schedule=schedule)) as a,
        fleet.connect() as connection,
    ):
        client = client_of(connection)
        goals = [await client.send_goal(-1) for _ in range(3)]
        a.own(goals[1].goal_id, stamp=goals[1].stamp)
        await settled()
        places = {info.goal_id: info.place for info in await client.goals()}
        assert [places[goal.goal_id] for goal in goals] == [0, 0, 2]
