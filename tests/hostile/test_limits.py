"""Each limit of a server, as one client reaches it: what it is told, and that others go on."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Limits
from fibaction.wire.frames import header
from fibaction.wire.messages import (
    Ended,
    Failed,
    Follow,
    Following,
    Goodbye,
    ListActions,
    Received,
    Rejected,
    Watching,
    WatchStatus,
    Welcome,
    Why,
)
from fibaction.words.statuses import GoalStatus
from tests.hostile.arena import PATIENCE, SHUTDOWN, be_honest, honest_client, started
from tests.hostile.attack import MIB, MOST, goal_id, sending
from tests.hostile.floods import SHORT
from tests.hostile.goal_attacks import ONE, begun
from tests.hostile.raw_client import Lost, Target, until
from tests.hostile.victim import Settings

pytestmark = pytest.mark.asyncio

TESTED = {
    "connections",
    "per_address",
    "goals",
    "follows",
    "lost",
    "requests",
    "frame",
    "memory",
    "total_memory",
    "queue",
    "handshake",
    "heartbeat",
    "write",
}
"""The limits that the tests below reach, and those of `test_doors`."""


@asynccontextmanager
async def limited(
    server: dict[str, Any] | None = None,
    wire: dict[str, Any] | None = None,
    **limits: int | float,
) -> AsyncGenerator[Target, None]:
    """Start a server with these limits. When the block ends, it answers an honest client, and ends
    in time.
    """
    settings = Settings(limits=limits, server=server or {}, wire=wire or {})
    with started(settings) as running, anyio.fail_after(PATIENCE):
        yield Target(running.url)
        latencies: list[float] = []
        async with honest_client(running, settings) as client, anyio.create_task_group() as tasks:
            tasks.start_soon(be_honest, client, running, latencies, [])
            await until(lambda: len(latencies) >= 3)
            tasks.cancel_scope.cancel()
        _, code = await running.stop(SHUTDOWN + 10)
        assert code == 0


def payload(size: int) -> bytes:
    return msgspec.msgpack.encode({"payload": bytes(size)})


async def test_each_limit_has_a_test() -> None:
    assert set(Limits.__struct_fields__) == TESTED


async def test_one_connection_too_many_is_told_that_the_server_is_full() -> None:
    async with limited(connections=3) as target:
        async with target.dial_many(3) as raws:
            for raw in raws:
                await raw.hear(Welcome)
            async with target.dial() as more:
                assert (await more.hear(Goodbye)).why == Why.LIMIT
                await more.ended()


async def test_one_goal_too_many_is_rejected() -> None:
    async with limited(goals=3) as target, target.dial() as raw:
        for id in range(1, 4):
            await begun(raw, sending(id, "forever", ONE, None))
        await raw.say(sending(4, "forever", ONE, None))
        assert isinstance(await raw.answer(4), Rejected)


async def test_one_follow_too_many_of_a_goal_fails() -> None:
    async with limited(follows=3) as target, target.dial() as raw:
        goal = await begun(raw, sending(next(raw.ids), "forever", ONE, None))
        answers = []
        for id in range(2, 6):
            await raw.say(Follow(id, "forever", goal.goal_id, None, False, MOST))
            answers.append(await raw.answer(id))
        assert isinstance(answers[0], Following)
        assert isinstance(answers[-1], Failed)
        assert answers[-1].why == Why.LIMIT


async def test_goals_of_lost_connections_are_given_up_when_they_are_too_many() -> None:
    orphans = {"orphans": "cancel", "grace": 1000.0}
    async with limited(wire=orphans, lost=1) as target, target.dial() as other:
        goals = []
        for number in range(3):
            async with target.dial(session=bytes([number]) * 32) as raw:
                goals.append(await begun(raw, sending(1, "forever", ONE)))
        for id, goal in enumerate(goals[:2], 1):
            await other.say(Follow(id, "forever", goal.goal_id, None, False, None))
            assert (await other.hear(Ended, id)).status is GoalStatus.CANCELED
        await other.say(Follow(3, "forever", goals[2].goal_id, None, False, None))
        assert (await other.hear(Following, 3)).status is GoalStatus.EXECUTING


async def test_one_request_too_many_fails() -> None:
    async with limited(requests=3) as target, target.dial() as raw:
        for id, action in enumerate(("forever", "echo", "grow"), 1):
            await raw.say(WatchStatus(id, action, MOST))
            await raw.hear(Watching, id)
        await raw.say(ListActions(4))
        failed = await raw.answer(4)
        assert isinstance(failed, Failed)
        assert failed.why == Why.LIMIT


async def test_a_frame_that_is_too_long_ends_the_connection_when_it_is_announced() -> None:
    async with limited(frame=10_000) as target, target.dial() as raw:
        await raw.hear(Welcome)
        await raw.write(header(10_001))
        assert (await raw.hear(Goodbye)).why == Why.PROTOCOL
        await raw.ended()


async def test_a_goal_is_rejected_while_those_that_are_decided_upon_hold_too_many_bytes() -> None:
    async with limited(memory=2 * MIB, frame=4 * MIB) as target, target.dial() as raw:
        await raw.say(*(sending(id, "slow", payload(MIB)) for id in range(1, 4)))
        assert isinstance(await raw.answer(3), Rejected)


async def test_goals_of_all_connections_that_are_decided_upon_have_a_limit_in_bytes() -> None:
    async with limited(memory=4 * MIB, total_memory=4 * MIB, frame=4 * MIB) as target:
        async with target.dial_many(4) as raws:
            goal = sending(1, "slow", payload(int(1.5 * MIB)))
            for raw in raws[:2]:
                await raw.say(goal)
                await raw.fence()  # no two arrive at the same time: parts count, too
            for raw in raws[2:]:
                with suppress(*Lost):
                    await raw.say(goal)
                answer = await raw.hear(object)
                while isinstance(answer, Welcome):
                    answer = await raw.hear(object)
                assert isinstance(answer, Rejected | Goodbye)


async def test_large_frames_of_all_connections_that_have_arrived_in_part_have_a_limit() -> None:
    async with limited(total_memory=4 * MIB, frame=4 * MIB) as target:
        async with target.dial_many(4) as raws:
            for raw in raws:
                await raw.hear(Welcome)
                await raw.write(header(2 * MIB) + bytes(int(1.5 * MIB)))
            while all(raw.is_open for raw in raws):  # one that was given up ends when more comes
                for raw in raws:
                    with suppress(*Lost):
                        await raw.write(b"0")
                await anyio.sleep(0.01)


async def test_a_client_that_asks_for_more_than_it_reads_is_ended() -> None:
    async with limited(queue=10_000) as target, target.dial(reads=False) as raw:
        with pytest.raises((OSError, anyio.BrokenResourceError)), anyio.fail_after(20):
            id = 0
            while True:
                messages = []
                for _ in range(500):
                    id += 1
                    messages.append(sending(id, "x" * 100, b""))
                await raw.say(*messages)


async def test_a_client_that_does_not_say_hello_in_time_is_ended() -> None:
    async with limited(handshake=0.2) as target, target.dial(hello=False) as raw:
        assert (await raw.hear(Goodbye)).why == Why.LIMIT
        await raw.ended()


async def test_a_silent_client_counts_as_dead_even_if_it_asks_for_a_longer_heartbeat() -> None:
    async with limited(heartbeat=0.05) as target, target.dial(heartbeat=3600.0) as raw:
        await raw.hear(Welcome)
        await raw.ended(within=5)


async def test_results_that_are_too_many_are_forgotten() -> None:
    async with limited(server={"max_results": 3}) as target, target.dial() as raw:
        names = [goal_id() for _ in range(5)]
        for id, name in enumerate(names, 1):
            await raw.say(sending(id, "fibonacci", SHORT, MOST, name))
            await raw.hear(Ended, id)
            await raw.say(Received(id))
        await raw.say(Follow(100, "fibonacci", names[0], None, False, None))
        failed = await raw.answer(100)
        assert isinstance(failed, Failed)
        assert failed.why == Why.UNKNOWN_GOAL
