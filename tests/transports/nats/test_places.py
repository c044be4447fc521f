"""Questions of a client for workers that have room."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction import ConnectionLost, GoalRejected, GoalStatus, ServerNotFound
from fibaction.border.event_loop import Background
from fibaction_transports.nats.client.free_workers import (
    FIRST_WAIT,
    OFFER_LIFE,
    RETURN_WAIT,
    ROOM_WAIT,
    RoomFinder,
)
from fibaction_transports.nats.records import RoomOffer, encode, question
from fibaction_transports.nats.workers import FleetWorkers
from tests.support.virtual_time import in_virtual_time
from tests.transports.nats.fake_fleet import NAMES, FakeFleet, client_of, server
from tests.wire.memory import Running, settled

pytestmark = [pytest.mark.anyio, in_virtual_time()]


@pytest.fixture
def fleet() -> FakeFleet:
    return FakeFleet()


@asynccontextmanager
async def places_of(fleet: FakeFleet, patience: float = 10) -> AsyncGenerator[RoomFinder, None]:
    async with Background() as tasks:
        workers = FleetWorkers(fleet.broker, NAMES, tasks, 5)
        yield RoomFinder(fleet.broker, NAMES, workers, tasks, patience)


def goals_asked(fleet: FakeFleet) -> list[int]:
    return [question(data).goals for data in fleet.broker.questions]


async def test_goals_that_wait_are_asked_for_together(fleet: FakeFleet) -> None:
    taken: list[str] = []

    async def take() -> None:
        taken.append((await places.take("count")).worker)

    async with fleet.worker("a").serve(server()), places_of(fleet) as places:
        async with anyio.create_task_group() as tasks:
            for _ in range(40):
                tasks.start_soon(take)
        assert taken == ["a"] * 40
        assert goals_asked(fleet) == [40, 24, 8]
        assert (await places.take("count")).worker == "a"
        assert goals_asked(fleet)[3:] == [1]


# Places that goals have left


async def test_quick_goals_one_after_another_need_few_questions(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), fleet.connect() as connection:
        client = client_of(connection)
        for _ in range(20):
            await client.call(0)
        assert goals_asked(fleet) == [1]
        await anyio.sleep(OFFER_LIFE)
        await client.call(0)
        assert goals_asked(fleet) == [1, 1]


def goal_of(status: GoalStatus = GoalStatus.EXECUTING) -> Any:
    goal = SimpleNamespace(status=status)
    goal.when_ended = lambda callback: setattr(goal, "end", callback)
    return goal


async def test_a_goal_that_waits_gets_the_place_of_one_that_ends(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        goal = goal_of()
        places.fill("count", await places.take("count"), goal)
        a.is_frozen = True
        async with Running(lambda: places.take("count")) as taking:
            await settled()
            goal.end()
            place = await taking.answer()
        assert (place.worker, place.is_used) == ("a", True)


@pytest.mark.parametrize("change", ["gone", "busy", "old"])
async def test_a_place_that_may_be_taken_is_not_used_again(fleet: FakeFleet, change: str) -> None:
    async with fleet.worker("a").serve(server()) as a, fleet.connect() as connection:
        places = connection._parts.places
        await connection.workers()
        place = await places.take("count")
        for _ in range(3):
            places.fill("count", place, goal_of(GoalStatus.SUCCEEDED))
        assert (await places.take("count")).is_used
        async with fleet.worker("b").serve(server()):
            if change == "gone":
                a.die()
            elif change == "old":
                await anyio.sleep(OFFER_LIFE)
            else:
                places.refuse("count", place)
                a.deafen()
            await settled()
            taken = await places.take("count")
            assert not taken.is_used
            places.refuse("other", taken)


async def test_room_in_a_queue_is_not_used_again(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.deafen()
        a.listen(NAMES.queue("count"))
        places.fill("count", await places.take("count"), goal_of(GoalStatus.SUCCEEDED))
        assert not (await places.take("count")).is_used


async def test_a_worker_that_has_no_room_any_more_is_followed_by_a_question(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server(max_goals=1)) as a,
        fleet.connect() as connection,
        fleet.connect() as other,
    ):
        await client_of(connection).call(0)
        await client_of(other).send_goal(-1)
        async with fleet.worker("b").serve(server()):
            a.deafen()
            await settled()
            began = anyio.current_time()
            assert await client_of(connection).call(3) == "3"
            assert anyio.current_time() == pytest.approx(began, abs=0.01)
        assert goals_asked(fleet) == [1, 1, 1]


async def test_a_goal_that_waits_no_longer_needs_no_place(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.is_frozen = True
        with anyio.move_on_after(0.1):
            await places.take("count")
        async with Running(lambda: places.take("count")) as taking:
            a.is_frozen = False
            assert (await taking.answer()).worker == "a"
        assert goals_asked(fleet)[-1] == 1


async def test_a_worker_that_does_not_answer_is_left_for_another_soon(fleet: FakeFleet) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.worker("b").serve(server()),
        places_of(fleet) as places,
    ):
        a.is_frozen = True
        began = anyio.current_time()
        assert (await places.take("count")).worker == "b"
        assert anyio.current_time() - began == pytest.approx(FIRST_WAIT, abs=0.01)


async def test_workers_that_do_not_answer_are_asked_less_and_less(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        a.is_frozen = True
        text = "no worker of action 'count' has answered within 10 s: no answer"
        with pytest.raises(ConnectionLost, match=text):
            await places.take("count")
        assert len(a.asked) == 8


async def test_an_answer_that_cannot_be_read_is_like_none(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()), places_of(fleet) as places:
        fleet.broker.listen(NAMES.offer("count"), lambda data: b"?")
        for _ in range(2):
            assert (await places.take("count")).worker == "a"


async def test_workers_with_room_in_their_queue_are_asked_last(fleet: FakeFleet) -> None:
    async with fleet.worker("a").serve(server()) as a, places_of(fleet) as places:
        fleet.broker.listen(NAMES.queue("count"), lambda data: encode(RoomOffer("queue", 1)))
        assert (await places.take("count")).worker == "a"
        a.deafen()
        assert (await places.take("count")).worker == "queue"


async def test_busy_workers_are_told_apart_from_none(fleet: FakeFleet) -> None:
    async with places_of(fleet) as places:
        with pytest.raises(ServerNotFound, match="is not served in this fleet: there is nothing"):
            await places.take("count")
        async with fleet.worker("a").serve(server()) as a, fleet.worker("b").serve(server()) as b:
            for worker in (a, b):
                worker.deafen()
                worker.has_room = False
                worker.renew()
            await settled()
            with pytest.raises(GoalRejected) as caught:
                await places.take("count")
            assert caught.value.reason == "busy: all 2 workers of action 'count' are busy"
            b.die()
            await settled()
            assert (await places.take("count")).worker == "a"  # the only one answers itself


async def test_a_worker_that_has_room_by_its_lease_is_waited_for_a_moment(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.worker("b").serve(server()) as b,
        places_of(fleet) as places,
    ):
        a.deafen()
        b.deafen()
        began = anyio.current_time()
        with pytest.raises(GoalRejected):
            await places.take("count")
        assert anyio.current_time() - began == pytest.approx(ROOM_WAIT, abs=0.1)
        async with Running(lambda: places.take("count")) as taking:
            await anyio.sleep(ROOM_WAIT / 2)
            a.listen(NAMES.offer("count"))
            assert (await taking.answer()).worker == "a"


async def test_workers_are_waited_for_that_come_back_to_the_brokers_later_than_the_client(
    fleet: FakeFleet,
) -> None:
    async with (
        fleet.worker("a").serve(server()) as a,
        fleet.worker("b").serve(server()) as b,
        places_of(fleet) as places,
    ):
        a.deafen()
        b.deafen()
        fleet.broker.reconnected_at = anyio.current_time()
        async with Running(lambda: places.take("count")) as taking:
            await anyio.sleep(2 * ROOM_WAIT)
            a.listen(NAMES.offer("count"))
            assert (await taking.answer()).worker == "a"
        a.deafen()
        fleet.broker.reconnected_at -= RETURN_WAIT
        with pytest.raises(GoalRejected, match="busy"):
            await places.take("count")
