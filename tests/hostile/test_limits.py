"""Each limit of a server, as one client reaches it: what it is told, and that others go on."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from time import monotonic
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import Limits, RejectionCode
from fibaction.wire.frames import header
from fibaction.wire.messages import (
    Credit,
    Ended,
    Failed,
    Follow,
    Following,
    Goodbye,
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
from tests.hostile.goal_attacks import ONE, begun, ticking
from tests.hostile.raw_client import Lost, Target, until
from tests.hostile.victim import GROW, Settings, Sized

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


ACTIONS = ["forever", "echo", "grow", "fail"]
ONE_TOO_MANY: dict[str, Callable[[int, bytes], object]] = {
    "goals": lambda id, goal: sending(id, "forever", ONE, None),
    "follows": lambda id, goal: Follow(id, "forever", goal, None, False, MOST),
    "requests": lambda id, goal: WatchStatus(id, ACTIONS[id % 4], MOST),
}


@pytest.mark.parametrize("limit", ONE_TOO_MANY)
async def test_one_too_many_is_told_so(limit: str) -> None:
    limits: Any = {limit: 3}
    answers: list[Any] = []
    async with limited(**limits) as target, target.dial() as raw, target.dial() as other:
        goal = await begun(other, sending(1, "forever", ONE, None))
        for id in range(100, 104):
            await raw.say(ONE_TOO_MANY[limit](id, goal.goal_id))
            answers.append(await raw.answer(id))
    *_, third, last = answers
    assert isinstance(third, Following | Watching)
    assert last.code == RejectionCode.BUSY if limit == "goals" else last.why == Why.LIMIT


@pytest.mark.parametrize(
    ("limits", "said", "why"),
    [
        ({"frame": 10_000}, header(10_001), Why.PROTOCOL),
        ({"handshake": 0.2}, None, Why.LIMIT),
        ({"heartbeat": 0.05}, b"", None),
    ],
    ids=str,
)
async def test_a_client_beyond_a_limit_is_ended(
    limits: Any, said: bytes | None, why: int | None
) -> None:
    async with limited(**limits) as target:
        async with target.dial(hello=said is not None, heartbeat=3600.0) as raw:
            await raw.write(said or b"")
            if why is not None:
                assert (await raw.hear(Goodbye)).why == why
            await raw.ended()


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


async def test_feedback_without_a_reader_has_a_limit_in_bytes_and_its_goal_goes_on() -> None:
    async with limited(server={"max_bytes": 4 * MIB, "stall_timeout": 0.1}) as target:
        async with target.dial() as raw:
            await raw.say(sending(1, "ticker", ticking(0.0, MIB, 20), 0))
            await raw.hear(Following, 1)
            await raw.say(Follow(2, "ticker", goal_id(), None, False, None))
            await raw.hear(Failed, 2)
            async with target.dial() as other:  # other goals are accepted beside it
                await other.say(sending(1, "fibonacci", SHORT))
                await other.hear(Ended, 1)


@pytest.mark.promise("RESULT-9")
async def test_results_that_one_client_does_not_read_push_out_no_results_of_others() -> None:
    goal = GROW.goal.encode(Sized(MIB))
    async with (
        limited(server={"max_bytes": 8 * MIB}, frame=2 * MIB) as target,
        target.dial() as honest,
        target.dial() as raw,
    ):
        name = goal_id()
        await honest.say(sending(1, "grow", goal, MOST, name))
        await honest.hear(Ended, 1)
        names = [goal_id() for _ in range(20)]
        for id, one in enumerate(names, 1):  # without `Received`, a result counts as unread
            await raw.say(sending(id, "grow", goal, MOST, one))
            if isinstance(rejected := await raw.answer(id), Rejected):
                break
            await raw.hear(Ended, id)
        assert isinstance(rejected, Rejected)
        assert rejected.reason.startswith("busy: its client has not read results of ")
        await raw.say(Follow(101, "grow", names[0], None, False, None))
        failed = await raw.answer(101)
        assert isinstance(failed, Failed)
        assert failed.why == Why.UNKNOWN_GOAL
        await honest.say(Follow(2, "grow", name, None, False, None))
        assert isinstance(await honest.answer(2), Following)
        await honest.hear(Ended, 2)


async def test_a_goal_that_another_client_sends_again_is_not_held_up_by_it() -> None:
    name, goal = goal_id(), ticking(0.0, 10, 600)  # more than the server remembers
    with started(Settings()) as server, anyio.fail_after(PATIENCE):
        target = Target(server.url)
        async with target.dial(session=b"h" * 32) as owner, target.dial(session=b"a" * 32) as other:
            await begun(owner, sending(1, "ticker", goal, 0, name))
            for id in range(1, 4):
                await other.say(sending(id, "ticker", goal, 0, name))
                await other.hear(Following, id)
            sent = monotonic()
            await owner.say(Credit(1, MOST))
            await owner.hear(Ended, 1)
            assert monotonic() - sent < 9  # an owner would hold it for 10 s
