"""The history of a fleet as its clients read it: pages, goals, and the histories of gateways."""

from __future__ import annotations

import pytest

from fibaction import ConnectionLost, GoalID, GoalInfo, GoalStatus, ServerNotFound
from fibaction.border.abc import Endpoint, ForwardingEndpoint
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from fibaction_transports.nats.records import encode
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import (
    COUNT,
    ENDED,
    GOAL_ID,
    NAMES,
    THREE,
    FakeFleet,
    FakeWorker,
    client_of,
    server,
)

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


def past(number: int = 7, goal_id: GoalID = GOAL_ID) -> StoredGoal:
    """Return a goal of the past that was accepted as the number-th one."""
    fields = ENDED | {"goal": THREE, "began_at": number, "meta": {"order": "17"}, "worker": "gone"}
    return StoredGoal(goal_id, number, UNKNOWN_SENDER, digest_of(THREE), attempt=1, **fields)


def note(fleet: FakeFleet, *goals: StoredGoal) -> None:
    for one in goals:
        fleet.broker.store(NAMES.past("count", one.goal_id, one.stamp), encode(one))


def numbered(number: int) -> StoredGoal:
    return past(number, GoalID(bytes([number]) * 16))


async def test_a_goal_of_the_past_is_followed_as_if_it_were_remembered(fleet: FakeFleet) -> None:
    note(fleet, past())
    async with fleet.connect() as connection:
        stream = await connection.endpoint(COUNT).feedback(GOAL_ID)
        assert (stream.goal, stream.info) == (THREE, past().info)
        assert (await stream.outcome()).result == COUNT.result.encode("3")
        with pytest.raises(ServerNotFound):
            await connection.endpoint(COUNT).feedback(GoalID(bytes([9]) * 16))


async def test_a_goal_that_its_owner_has_forgotten_is_found_in_the_history(
    fleet: FakeFleet,
) -> None:
    note(fleet, past())
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        a.own(GOAL_ID, **ENDED)
        stream = await connection.endpoint(COUNT).feedback(GOAL_ID)
        assert stream.info.labels == {"order": "17"}


async def test_a_goal_that_has_ended_at_a_worker_is_told_as_its_record_says(
    fleet: FakeFleet,
) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        client = client_of(connection)
        goal = await client.send_goal(3, labels={"order": "17"})
        await goal.result()
        [listed] = await client.goals()
        stream = await connection.endpoint(COUNT).feedback(goal.goal_id)
        assert stream.info == listed
        assert listed.worker == "a"


class _WithPast(ForwardingEndpoint):
    """A gateway whose server has a history."""

    def __init__(self, inner: Endpoint, *infos: GoalInfo) -> None:
        super().__init__(inner)
        self._infos = infos

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        return [info for info in self._infos if page.has(info)]


async def test_pages_have_the_goals_of_gateways_as_well(fleet: FakeFleet) -> None:
    infos = [
        GoalInfo(GoalID(bytes([number]) * 16), number, GoalStatus.ABORTED) for number in (3, 1)
    ]
    note(fleet, numbered(2), numbered(4))
    gateway = fleet.worker("g", is_kept=False)
    async with gateway.serve(_WithPast(server(), *infos)), fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        found = await endpoint.past_goals(PastPage())
        oldest = await endpoint.past_goals(PastPage(limit=2, newest_first=False))
        read: list[GoalInfo] = []
        await endpoint.read_past(GoalQuery(since=2), read.extend)
    assert sorted(info.stamp for info in read) == [2, 3, 4]
    assert [info.stamp for info in found] == [4, 3, 2, 1]
    assert [info.stamp for info in oldest] == [1, 2]


async def test_a_history_that_cannot_be_read_is_a_lost_connection(
    fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeWorker(fleet.broker, "gone").own(GOAL_ID)
    async with fleet.connect() as connection:
        endpoint = connection.endpoint(COUNT)
        await connection.workers()
        fleet.broker.is_away = True
        with pytest.raises(ConnectionLost, match="the history of the fleet cannot be read"):
            await endpoint.past_goals(PastPage())
        with pytest.raises(ConnectionLost, match=f"the record of goal {GOAL_ID} cannot be read"):
            await endpoint.rerun(GOAL_ID)
