"""A worker from its start to its end, with clients of the fleet, over brokers in memory."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import msgspec
import pytest
from anyio import create_task_group, fail_after, sleep, sleep_forever

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Schedule
from fibaction.words.errors import GoalRejected, TransportError
from fibaction_transports.nats.broker.broker import BrokerStream
from fibaction_transports.nats.client.connection import open_fleet
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import (
    RoomQuestion,
    ServedAction,
    encode,
    lease_entry,
    offer,
)
from fibaction_transports.nats.settings import FleetSettings
from fibaction_transports.nats.worker.worker import Worker, open_worker
from tests.simulation.loop import VirtualLoop
from tests.support.memory_broker import MemoryBroker, MemoryBrokers, nothing
from tests.transports.hearing import Hearing

VIRTUAL = ("asyncio", {"loop_factory": VirtualLoop})  # lines need asyncio
pytestmark = [
    pytest.mark.anyio,
    pytest.mark.parametrize("anyio_backend", [VIRTUAL], ids=["virtual"]),
]
NAMES = FleetNames("test")
COUNT = Action("count", goal=int, feedback=str, result=int)
LEASE = 5.0


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int, None]:
    """Take as many seconds as the goal says; return the number of the attempt."""
    await sleep(goal.request)
    yield goal.attempt


def settings(name: str = "robot") -> FleetSettings:
    return FleetSettings("test", worker=name, lease=LEASE)


@asynccontextmanager
async def serving(
    broker: MemoryBroker, server: ActionServer[Any, Any, Any], name: str = "robot"
) -> AsyncGenerator[Worker, None]:
    """Serve as `fibaction.serve` does."""
    async with open_worker(broker, NAMES, settings(name)) as worker:
        server.keep_in(worker.store)
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(server)
            await stack.enter_async_context(worker.serve([server]))
            stack.push_async_callback(server.stop)
            yield worker


@asynccontextmanager
async def client(broker: MemoryBroker) -> AsyncGenerator[ActionClient[int, str, int], None]:
    async with open_fleet(broker, NAMES, settings("")) as fleet:
        yield ActionClient(fleet.endpoint(COUNT), COUNT)


def lease(shared: MemoryBrokers, name: str = "robot") -> Any:
    record = shared.record_of(NAMES.worker(name))
    return lease_entry(record.data)


async def test_a_lease_lists_what_the_worker_serves() -> None:
    async with MemoryBrokers() as shared:
        async with serving(shared.member(), ActionServer(COUNT, count)):
            assert lease(shared).actions == (ServedAction(COUNT.info, is_kept=True),)
            assert lease(shared).has_room
            async with client(shared.member()) as caller, create_task_group() as tasks:
                tasks.start_soon(caller.call, 10)
                await sleep(3)
                assert lease(shared).goals == 1
                tasks.cancel_scope.cancel()
        assert lease(shared).incarnation == b""


async def test_a_gateway_keeps_nothing_and_always_has_room() -> None:
    async with MemoryBrokers() as shared:
        async with (
            ActionServer(COUNT, count) as server,
            open_worker(shared.member(), NAMES, settings()) as worker,
            worker.serve([server]),
        ):
            assert lease(shared).actions == (ServedAction(COUNT.info, is_kept=False),)
            asked = encode(RoomQuestion(99))
            answer = await shared.member().request(NAMES.offer("count"), asked, 5)
            assert (offer(answer).worker, offer(answer).goals) == ("robot", 16)


async def test_a_worker_answers_only_while_it_has_room() -> None:
    async with MemoryBrokers() as shared:
        server = ActionServer(COUNT, count, schedule=Schedule(concurrency=1))
        async with serving(shared.member(), server), client(shared.member()) as caller:
            async with create_task_group() as tasks:
                tasks.start_soon(caller.call, 5)
                await sleep(2)
                assert not lease(shared).has_room
                with fail_after(4), pytest.raises(GoalRejected, match="busy"):
                    await caller.call(1)
            await sleep(1.5)
            assert lease(shared).has_room
            with fail_after(10):
                assert await caller.call(1) == 1


async def test_a_question_that_is_not_one_is_not_answered() -> None:
    async with MemoryBrokers() as shared:
        async with serving(shared.member(), ActionServer(COUNT, count)):
            asker = shared.member()
            found: list[object] = []
            await asker.subscribe("_INBOX.x", found.append)
            asker.publish(NAMES.offer("count"), b"rubbish", "_INBOX.x")
            await sleep(1)
            assert not found


async def test_a_worker_without_brokers_says_so_in_one_sentence() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()
        async with open_worker(broker, NAMES, settings()) as worker:
            broker.is_away = True
            with pytest.raises(TransportError, match="cannot serve in the fleet"):
                async with worker.serve([ActionServer(COUNT, count)]):
                    await sleep_forever()


async def test_a_worker_that_loses_the_brokers_as_it_joins_says_so() -> None:
    async with MemoryBrokers() as shared:
        broker = shared.member()

        async def away(call: str, _subject: str) -> None:
            if call == "subscribe":
                broker.is_away = True

        broker.before = away
        with pytest.raises(TransportError, match="cannot join the fleet"):
            async with open_worker(broker, NAMES, settings()):
                await sleep_forever()


# Workers of different versions


class Old(msgspec.Struct):
    n: int


class New(msgspec.Struct):
    n: int
    unit: str


async def steps(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    await sleep(1)
    yield goal.request.n


def steps_by(version: type[Old] | type[New], concurrency: int) -> ActionServer[Any, Any, Any]:
    return ActionServer(
        Action("steps", goal=version, feedback=str, result=int),
        steps,
        schedule=Schedule(concurrency=concurrency, queue=300),
        recovery="rerun",
    )


@pytest.mark.promise("FLEET-7")
@pytest.mark.parametrize("is_lost", [False, True])
async def test_a_worker_of_another_version_leaves_goals_to_those_that_can_run_them(
    is_lost: bool, log: Hearing
) -> None:
    ended: list[int] = []
    async with MemoryBrokers() as shared:
        brokers = [shared.member(name) for name in "abc"]
        async with (
            serving(brokers[0], steps_by(Old, 2), "a"),
            serving(brokers[1], steps_by(Old, 2), "b"),
            open_fleet(shared.member(), NAMES, settings("")) as fleet,
            create_task_group() as callers,
        ):
            action = Action("steps", goal=Old, feedback=str, result=int)
            caller = ActionClient(fleet.endpoint(action), action)

            async def call(number: int) -> None:
                ended.append(await caller.call(Old(number)))

            for number in range(60):
                callers.start_soon(call, number)
            await sleep(3)
            async with serving(brokers[2], steps_by(New, 9), "c"):
                await sleep(3)
                brokers[0].is_away = is_lost
                await sleep(60)
                brokers[0].is_away = False
                assert lease(shared, "c").actions[0].unreadable == 0
    assert sorted(ended) == list(range(60))
    unread = [one for one in log.warnings if "cannot run at this one" in one]
    assert len(unread) < 5, "not a line for each goal"
    assert is_lost or not unread, "as long as their worker lives, they have one"


# Lost streams


@pytest.mark.promise("FLEET-8")
async def test_a_worker_fills_the_streams_again_as_soon_as_they_can_be_made(log: Hearing) -> None:
    async def no_space(call: str, _subject: str) -> None:
        if call == "create_streams":
            raise TransportError("there is no space left")

    async with MemoryBrokers() as shared:
        broker = shared.member()
        server = ActionServer(COUNT, count, schedule=Schedule(concurrency=1, queue=9))
        async with serving(broker, server), client(shared.member()) as caller:
            goals = [await caller.send_goal(seconds) for seconds in (10, 1)]
            await sleep(1)
            shared.lose_streams()
            broker.before = no_space
            await sleep(LEASE / 4)
            broker.before = nothing
            broker.is_away = True
            await sleep(LEASE / 4)
            broker.is_away = False
            shared.stream = BrokerStream("second", 1.0)
            await sleep(LEASE / 4)
            assert lease(shared).actions
            assert len(shared.matching(NAMES.all_goals())) == 2
            assert [note.subject for note in shared.notes] == [NAMES.want("count")]
            with fail_after(3 * LEASE):
                assert [await goal.result() for goal in goals] == [1, 1]
    errors = [one.getMessage() for one in log.records if one.levelname == "ERROR"]
    assert errors == [
        "the stream FIB_test_WORKERS was lost, and with it the leases of workers",
        "the stream FIB_test_GOALS was lost, and with it outcomes, and goals that had no worker",
        "the stream FIB_test_NOTES was lost, and with it notes of goals that wait or are left",
    ]
    assert "worker 'robot': there is no space left" in log.warnings
