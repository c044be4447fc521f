"""A schedule whose limit all workers of a fleet have together, by places that a test grants."""

from __future__ import annotations

import enum
import math
from collections.abc import AsyncGenerator, Callable
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientGoal,
    GoalHandle,
    GoalID,
    GoalRejected,
    GoalStatus,
    Schedule,
    SqliteStore,
)
from fibaction.border.goal_store import KeySlots, NoFleet
from fibaction.server.scheduling.scheduled_goals import Act, Order
from fibaction.server.scheduling.shared_scheduler import NO_KEY, FleetScheduler, portable
from tests.server.held import id_of
from tests.support.memory_store import MemoryJournal, MemoryStore
from tests.support.virtual_time import in_virtual_time

MOVE = Action("move", goal=str, feedback=int, result=str)
GRASP = Action("grasp", goal=str, feedback=int, result=str)
ONE: Any = {"concurrency": 1, "queue": 3, "fleet_limit": "arms"}


class Slots(KeySlots):
    """Places that note what they are told."""

    def __init__(self) -> None:
        self.numbers: dict[bytes, tuple[int, int]] = {}
        self.granted: Callable[[bytes], None] = print
        self.is_open = False

    def open(self, granted: Callable[[bytes], None]) -> None:
        self.is_open, self.granted = True, granted

    def note(self, key: bytes, running: int, asked: int) -> None:
        self.numbers[key] = running, asked

    def close(self) -> None:
        self.is_open = False


A, B, C, D = map(id_of, range(1, 5))


class Played:
    """A scheduler, and its places."""

    def __init__(self, **settings: Any) -> None:
        self.places = Slots()
        self.scheduler = FleetScheduler(Schedule(**ONE | settings), self.places, kill_after=3)

    def offer(self, goal_id: GoalID, key: bytes = b"x", **terms: Any) -> list[Order]:
        return self.scheduler.offer(goal_id, key=key, **{"now": 0, **terms})

    def grant(self, key: bytes = b"x", now: float = 0) -> list[Order]:
        return self.scheduler.granted(key, now)

    def x(self) -> tuple[int, int]:
        return self.places.numbers[b"x"]


def starts(*goals: GoalID) -> list[Order]:
    return [Order(Act.START, one) for one in goals]


# The scheduler


def test_a_place_is_given_back_between_two_goals_of_a_key() -> None:
    one = Played()
    one.offer(A)
    one.offer(B)
    assert one.x() == (0, 1)  # more than the one place cannot be used here
    one.grant()
    assert one.x() == (1, 0)
    assert one.scheduler.leave(A, 1) == []
    assert one.x() == (0, 1)
    assert one.grant() == starts(B)
    assert one.scheduler.leave(B, 2) == []
    assert one.x() == (0, 0)


def test_a_place_that_no_goal_needs_any_longer_is_not_used() -> None:
    one = Played()
    one.offer(A)
    assert one.scheduler.leave(A, 1) == []
    assert one.x() == (0, 0)
    assert one.grant() == []
    one.offer(B)
    one.grant()
    assert one.grant() == []
    assert one.x() == (1, 0)


def test_a_goal_that_has_expired_leaves_its_place_to_the_next_one() -> None:
    one = Played(skip_expired=True)
    one.offer(A, expires=5)
    one.offer(B)
    ended, started = one.grant(now=6)
    assert (ended.act, ended.goal_id) == (Act.END, A)
    assert started == Order(Act.START, B)
    one.offer(C, expires=7)
    one.scheduler.leave(B, 8)
    (ended,) = one.grant(now=8)
    assert (ended.act, ended.goal_id) == (Act.END, C)
    assert one.x() == (0, 0)


def test_a_place_that_is_asked_for_counts_for_the_total() -> None:
    one = Played(total=2, key=str)
    one.offer(A, b"x")
    one.offer(B, b"y")
    one.offer(C, b"z")
    assert one.places.numbers == {b"x": (0, 1), b"y": (0, 1)}
    assert one.scheduler.capacity() == (0, math.inf)
    assert one.grant(b"y") == starts(B)
    assert b"z" not in one.places.numbers
    one.scheduler.leave(B, 1)
    assert one.places.numbers[b"z"] == (0, 1)


def test_the_next_key_asks_when_a_goal_has_waited_too_long() -> None:
    one = Played(total=1, queue_timeout=5)
    one.offer(A, b"x", now=0)
    one.offer(B, b"y", now=1)
    assert b"y" not in one.places.numbers
    assert [order.act for order in one.scheduler.due(5)] == [Act.END]
    assert one.places.numbers == {b"x": (0, 0), b"y": (0, 1)}


def test_the_next_key_asks_when_a_granted_place_finds_no_goal() -> None:
    one = Played(total=1, skip_expired=True)
    one.offer(A, b"x", expires=1)
    one.offer(B, b"y")
    assert [order.act for order in one.grant(b"x", now=2)] == [Act.END]
    assert one.places.numbers == {b"x": (0, 0), b"y": (0, 1)}


# The settings


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"concurrency": None}, "fleet_limit='arms' needs a number of goals: set concurrency, too"),
        ({"queue": 0}, "fleet_limit='arms' needs a queue of at least 1, not 0: each goal waits"),
        ({"when_full": "preempt"}, "fleet_limit='arms' cannot preempt: the goals that run may be"),
        ({"fleet_limit": "x" * 51}, "fleet_limit has at most 50 characters"),
    ],
)
def test_a_limit_that_cannot_hold_in_a_fleet_is_an_error(
    settings: dict[str, Any], text: str
) -> None:
    if settings.get("concurrency", 1) is None:
        settings = {**settings, "queue": 0}
    with pytest.raises(ValueError, match=text):
        Schedule(**ONE | settings)


def test_the_name_of_a_limit_is_a_text() -> None:
    with pytest.raises(TypeError, match="fleet_limit must be a text, not 5"):
        Schedule(**ONE | {"fleet_limit": 5})


class Arm(enum.Enum):
    LEFT = "left"


@pytest.mark.parametrize("key", ["left", 7, 2.5, None, ("left", 7), Arm.LEFT, b"bytes", True])
def test_a_key_is_the_same_bytes_each_time(key: Any) -> None:
    assert portable(key) == portable(key)


def test_other_keys_are_other_bytes() -> None:
    assert len({portable(key) for key in ("1", 1, (1,), b"1", True, None)}) == 6


@pytest.mark.parametrize("key", [object(), 2**70, {object(): 1}])
def test_a_key_that_no_other_process_knows_is_an_error(key: Any) -> None:
    with pytest.raises(TypeError, match="a key for a fleet is a text, a number, or a tuple"):
        portable(key)


def test_a_key_that_is_not_equal_to_itself_is_an_error() -> None:
    with pytest.raises(ValueError, match="it returned nan, which is not equal to itself"):
        portable(math.nan)


# The server

in_time = in_virtual_time()


class Worker:
    """A store with places that the test grants."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.store = MemoryStore()
        self.places = Slots()
        self.opened: list[tuple[str, int]] = []

        async def key_slots(_journal: MemoryJournal, limit: str, most: int) -> KeySlots:
            self.opened.append((limit, most))
            return self.places

        monkeypatch.setattr(MemoryJournal, "key_slots", key_slots)

    def server(
        self, schedule: Schedule, action: Action[str, int, str] = MOVE, **settings: Any
    ) -> ActionServer[str, int, str]:
        return ActionServer(action, move, schedule=schedule, store=self.store, **settings)


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Worker:
    return Worker(monkeypatch)


async def move(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    yield 1
    if goal.request.endswith("!"):
        await anyio.sleep_forever()
    yield goal.request


async def status(goal: ClientGoal[int, str]) -> GoalStatus:
    """Return the status of a goal when all that is due now has happened."""
    await anyio.sleep(0.1)
    return goal.status


@pytest.mark.anyio
@in_time
async def test_a_goal_begins_when_the_fleet_has_a_place(worker: Worker) -> None:
    schedule = Schedule(**ONE, key=lambda goal: goal.split()[0])
    async with worker.server(schedule) as server:
        client = ActionClient(server, MOVE)
        sent = await client.send_goal("left up")
        key = portable("left")
        assert worker.opened == [("arms", 1)]
        assert await status(sent) is GoalStatus.ACCEPTED
        assert worker.places.numbers == {key: (0, 1)}
        worker.places.granted(key)
        assert await sent.result() == "left up"
        assert worker.places.numbers == {key: (0, 0)}
    assert not worker.places.is_open


@pytest.mark.anyio
@in_time
async def test_a_place_may_be_granted_while_the_acceptance_is_written(worker: Worker) -> None:
    async with worker.server(Schedule(**ONE)) as server:
        client = ActionClient(server, MOVE)
        worker.store.hold()
        async with anyio.create_task_group() as tasks:
            results: list[str] = []

            async def call() -> None:
                results.append(await client.call("up"))

            tasks.start_soon(call)
            await anyio.sleep(0.1)
            worker.places.granted(NO_KEY)
            await anyio.sleep(0.1)
            assert worker.places.numbers == {b"": (1, 0)}
            worker.store.release()
        assert results == ["up"]


@pytest.mark.anyio
@in_time
async def test_a_goal_that_another_server_has_gives_its_place_back(worker: Worker) -> None:
    async with worker.server(Schedule(**ONE)) as server:
        client = ActionClient(server, MOVE)
        sent = await client.send_goal("up!")
        worker.places.granted(b"")
        assert await status(sent) is GoalStatus.EXECUTING
        worker.store.take("move", sent.goal_id)
        await anyio.sleep(0.1)
        assert worker.places.numbers == {b"": (0, 0)}


@pytest.mark.anyio
@in_time
async def test_servers_of_one_worker_may_share_a_schedule(worker: Worker) -> None:
    schedule = Schedule(**ONE)
    async with worker.server(schedule, GRASP) as grasps:
        async with worker.server(schedule) as moves:
            one = await ActionClient(moves, MOVE).send_goal("up")
            two = await ActionClient(grasps, GRASP).send_goal("key")
            assert worker.places.numbers == {b"": (0, 1)}
            worker.places.granted(b"")
            assert await one.result() == "up"
        assert worker.places.is_open
        worker.places.granted(b"")
        assert await two.result() == "key"
    assert not worker.places.is_open


@pytest.mark.anyio
@in_time
async def test_a_schedule_of_two_workers_is_an_error(worker: Worker) -> None:
    schedule = Schedule(**ONE)
    async with worker.server(schedule):
        worker.places, first = Slots(), worker.places
        with pytest.raises(ValueError, match="are served by one worker: give each worker a"):
            await worker.server(schedule, GRASP).__aenter__()
        assert first.is_open


@pytest.mark.anyio
@in_time
async def test_a_goal_whose_key_no_other_process_knows_is_rejected(worker: Worker) -> None:
    schedule = Schedule(**ONE, key=lambda goal: (goal, object()))
    async with worker.server(schedule) as server:
        with pytest.raises(GoalRejected, match="key failed: TypeError: it returned"):
            await ActionClient(server, MOVE).send_goal("up")


@pytest.mark.anyio
async def test_without_a_fleet_the_server_does_not_start(tmp_path: Any) -> None:
    why = "fleet_limit='arms' needs a fleet: serve the action at nats://, or leave it out"
    schedule = Schedule(**ONE)
    with pytest.raises(NoFleet, match=why):
        await ActionServer(MOVE, move, schedule=schedule).__aenter__()
    store = SqliteStore(tmp_path / "goals.db")
    with pytest.raises(NoFleet, match=why):
        await ActionServer(MOVE, move, schedule=schedule, store=store).__aenter__()
