"""Attacks with goals: many of them, followed, canceled, sent again, and left behind."""

from __future__ import annotations

from functools import partial

import anyio

from fibaction.wire.messages import (
    AskPeers,
    AwaitServer,
    CancelGoals,
    Close,
    Credit,
    Follow,
    Following,
    GoalChanged,
    Received,
    SendGoal,
    WatchStatus,
)
from tests.hostile.attack import MOST, attack, goal_id, sending
from tests.hostile.floods import SHORT, TERMS
from tests.hostile.raw_client import Raw, Target, each, packed
from tests.hostile.victim import TICKER, Beat

ONE = b"\x01"


def ticking(interval: float, size: int = 100, count: int = 2**31) -> bytes:
    return TICKER.goal.encode(Beat(interval, size, count))


async def begun(raw: Raw, message: SendGoal) -> SendGoal:
    """Send a goal, and wait until it is accepted."""
    await raw.say(message)
    await raw.hear(Following, message.id)
    return message


async def hold(raw: Raw, action: str, goals: int) -> list[int]:
    """Send goals that do not end, wait until they are accepted, and return their IDs."""
    ids = [next(raw.ids) for _ in range(goals)]
    for start in range(0, goals, 500):
        await raw.say(*(sending(id, action, ONE, None) for id in ids[start : start + 500]))
        await raw.fence()
    return ids


async def follow_one_often(target: Target, connections: int) -> None:
    """Follow one goal thousands of times over a few connections, while it yields feedback."""
    async with target.dial() as sender, target.dial_many(connections) as raws:
        goal = await begun(sender, sending(1, "ticker", ticking(0.02)))

        async def one(raw: Raw) -> None:
            ids = [next(raw.ids) for _ in range(target.size(2000, 9000))]
            follows = (Follow(id, "ticker", goal.goal_id, None, False, MOST) for id in ids)
            await raw.write(packed(*follows))
            await raw.fence()
            await anyio.sleep(0.3)

        await each(raws, one)


for _connections in (1, 3):
    attack(f"one goal followed often x {_connections}", above=96)(
        partial(follow_one_often, connections=_connections)
    )


@attack("follows that come and go")
async def follow_churn(target: Target) -> None:
    async with target.dial() as raw:
        goal = await begun(raw, sending(next(raw.ids), "ticker", ticking(0.01)))
        for _ in range(20):
            for id in [next(raw.ids) for _ in range(90)]:
                follow = Follow(id, "ticker", goal.goal_id, None, False, 0)
                await raw.say(follow, Credit(id, MOST), Close(id), Received(id))
            await raw.fence()


@attack("all canceled often", above=128)
async def cancel_all_often(target: Target) -> None:
    """Cancel all goals again and again, which do not end."""
    async with target.dial() as raw:
        await hold(raw, "deaf", target.size(2000, 5000))
        cancels = target.size(100, 990)
        await raw.say(*(CancelGoals(next(raw.ids), "deaf", None, None) for _ in range(cancels)))
        await raw.fence()


@attack("all canceled often, unread", above=128)
async def cancel_all_unread(target: Target) -> None:
    async with target.dial(reads=False) as raw:
        goals = target.size(2000, 5000)
        await raw.say(*(sending(next(raw.ids), "deaf", ONE, None) for _ in range(goals)))
        for _ in range(10):
            await raw.say(*(CancelGoals(next(raw.ids), "deaf", None, None) for _ in range(99)))
            await anyio.sleep(0.05)


@attack("statuses followed often", above=160)
async def watch_often(target: Target) -> None:
    async with target.dial() as raw:
        ids = await hold(raw, "forever", target.size(2000, 9900))
        watches = [next(raw.ids) for _ in range(target.size(200, 990))]
        await raw.say(*(WatchStatus(id, "forever", MOST) for id in watches))
        await raw.count(GoalChanged, len(ids))
        await raw.say(*(CancelGoals(next(raw.ids), "forever", None, None) for _ in range(3)))
        await raw.fence()


@attack("statuses that come and go", above=128)
async def watch_churn(target: Target) -> None:
    async with target.dial() as raw:
        await hold(raw, "forever", target.size(1000, 9900))
        for _ in range(5):
            ids = [next(raw.ids) for _ in range(40)]
            await raw.say(*(m for id in ids for m in (WatchStatus(id, "forever", 1), Close(id))))
            await raw.fence()


@attack("statuses unread", above=128)
async def watch_unread(target: Target) -> None:
    async with target.dial(reads=False) as idle, target.dial() as raw:
        await idle.say(*(WatchStatus(id, "fibonacci", MOST) for id in range(1, 900)))
        for _ in range(5):
            ids = [next(raw.ids) for _ in range(200)]
            await raw.say(*(sending(id, "fibonacci", SHORT) for id in ids))
            await raw.fence()
            await raw.say(*map(Received, ids))


@attack("the same goal from two sessions", above=96)
async def same_goal_from_two(target: Target) -> None:
    """Send each goal from two sessions at once: as it is, and with another content."""
    async with (
        target.dial(session=b"a" * 32) as one,
        target.dial(session=b"b" * 32) as other,
    ):
        for _ in range(5):
            names = [goal_id() for _ in range(200)]
            ids = [next(one.ids) for _ in names]
            for raw, goals in ((one, [TERMS] * 200), (other, [TERMS, SHORT] * 100)):
                await raw.say(
                    *(
                        sending(id, "fibonacci", goal, 0, name)
                        for id, goal, name in zip(ids, goals, names, strict=True)
                    )
                )
            for raw in (one, other):
                await raw.fence()
                await raw.say(*(m for id in ids for m in (Close(id), Received(id))))
            for _ in range(200 - 1):
                next(other.ids)


@attack("games with credit", above=128)
async def credit_games(target: Target) -> None:
    """Grant no credit, the most, and some for requests that are not there."""
    async with target.dial() as raw:
        ids = [next(raw.ids) for _ in range(100)]
        await raw.say(*(sending(id, "ticker", ticking(0.0, 10, 500), 0) for id in ids))
        for amount in (0, 1, MOST, MOST):
            await raw.say(*(Credit(id, amount) for id in ids))
            await raw.say(*(Credit(2**62 + id, MOST) for id in ids))
        await raw.fence()
        await raw.say(*map(Close, ids), *map(Received, ids))
        await raw.say(*(sending(2**63 - 1 - id, "fibonacci", SHORT, MOST) for id in ids))
        await raw.fence()


async def chatty(target: Target, credit: int | None) -> None:
    async with target.dial() as raw:
        ids = [next(raw.ids) for _ in range(target.size(100, 1000))]
        await raw.say(*(sending(id, "ticker", ticking(0.0, 10), credit) for id in ids))
        await anyio.sleep(target.size(1, 5))
        await raw.say(CancelGoals(next(raw.ids), "ticker", None, None))
        await raw.fence()


attack("goals that yield without a pause", above=192)(partial(chatty, credit=MOST))
# Nothing holds up those without a reader.
attack("goals without a follower", above=192)(partial(chatty, credit=None))


@attack("goals that yield without a pause, unread", above=192)
async def chatty_unread(target: Target) -> None:
    async with target.dial(reads=False) as raw:
        goals = target.size(200, 2000)
        await raw.say(*(sending(next(raw.ids), "ticker", ticking(0.0, 10)) for _ in range(goals)))
        await anyio.sleep(0.5)


async def leave_goals(target: Target) -> None:
    """Leave goals behind on connections that come and go."""
    for _ in range(3):
        async with target.dial(session=goal_id() * 2) as raw:
            await hold(raw, "forever", target.size(300, 3000))


attack("goals left behind", above=192)(leave_goals)
attack("goals left behind, canceled", above=128, wire={"orphans": "cancel", "grace": 0.1})(
    leave_goals
)


@attack("goals that swallow their cancellation", above=64)
async def stubborn(target: Target) -> None:
    async with target.dial() as raw:
        await hold(raw, "stubborn", 20)
        await raw.say(CancelGoals(next(raw.ids), "stubborn", None, None))
        await raw.fence()
        await anyio.sleep(0.2)


@attack("peers asked of many connections", above=96)
async def peers_of_many(target: Target) -> None:
    async with target.dial_many(target.size(100, 900)) as raws:
        await each(raws, lambda raw: raw.say(AwaitServer(1, "fibonacci")))
        asking = raws[0]
        asked = target.size(300, 990)
        await asking.say(*(AskPeers(id, "fibonacci") for id in range(100, 100 + asked)))
        await asking.fence()


@attack(
    "permissions guessed",
    authorize="only_observe",
    wire={"tokens": {"honest": "honest", "hostile": "hostile"}},
)
async def forbidden(target: Target) -> None:
    async with target.dial() as raw:
        for _ in range(3):
            ids = [next(raw.ids) for _ in range(600)]
            await raw.say(*(sending(id, "fibonacci", SHORT) for id in ids[:300]))
            await raw.say(*(CancelGoals(id, "fibonacci", None, None) for id in ids[300:]))
            await raw.fence()
