"""Attacks on memory and on the log: large frames, payloads, texts, results and feedback."""

from __future__ import annotations

from functools import partial

import anyio
import msgspec

from fibaction.wire.frames import MAX_FRAME, header
from fibaction.wire.messages import CancelGoals, Close, Goodbye, ListActions, Received
from fibaction.wire.settings import Limits
from tests.hostile.attack import MIB, attack, goal_id, sending
from tests.hostile.goal_attacks import ticking
from tests.hostile.raw_client import Raw, Target, each, packed
from tests.hostile.victim import GROW, Sized

FORGED = "\r\n2026-01-01 00:00:00,000 fibaction.wire: FORGED \x1b[2J\u2028FORGED"
"""A text that makes a line of its own, where it is not cleaned."""
LARGE = Limits().frame - 1000
SMALL = {"max_bytes": 32 * MIB}


async def unfinished(target: Target, connections: int, size: int, *, hello: bool) -> None:
    """Send all of a large frame but its last byte, on each connection."""

    async def one(raw: Raw) -> None:
        data = bytes(64 * 1024)
        await raw.write(header(size))
        for _ in range(size // len(data)):
            await raw.write(data)
        await raw.write(data[: size % len(data) - 1])
        await anyio.sleep(0.3)

    async with target.dial_many(connections, hello=hello) as raws:
        await each(raws, one)


attack("large frames before the token")(
    partial(unfinished, connections=100, size=16 * MIB, hello=False)
)
attack("unfinished frames", above=96, total_memory=32 * MIB, frame=MAX_FRAME)(
    partial(unfinished, connections=20, size=8 * MIB, hello=True)
)
attack("unfinished frames of 16 MiB", above=320, long=True, frame=MAX_FRAME)(
    partial(unfinished, connections=100, size=16 * MIB, hello=True)
)


async def long_hello(target: Target, **fields: str | bytes) -> None:
    for _ in range(5):
        async with target.dial_many(4, **fields) as raws:
            await each(raws, lambda raw: raw.ended())


attack("tokens of 15 MB", wire={"tokens": {"honest": "honest"}})(
    partial(long_hello, token="x" * 15_000_000)
)
attack("sessions of 15 MB")(partial(long_hello, session=b"x" * 15_000_000))
attack("tokens of 4,000 bytes", wire={"tokens": {"honest": "honest"}})(
    partial(long_hello, token="x" * 4000)
)


async def large_goals(target: Target, action: str, goals: int, size: int) -> None:
    """Send goals of a large payload; they are undecided, accepted for ever, or end at once."""
    goal = msgspec.msgpack.encode({"payload": bytes(size)})
    async with target.dial() as raw:
        for _ in range(goals):
            await raw.say(sending(next(raw.ids), action, goal))
        await raw.fence()


async def large_goals_over_many(target: Target, action: str, size: int) -> None:
    goal = msgspec.msgpack.encode({"payload": bytes(size)})

    async def one(raw: Raw) -> None:
        for _ in range(5):
            await raw.say(sending(next(raw.ids), action, goal))
        await raw.fence()

    async with target.dial_many(10) as raws:
        await each(raws, one)


# How many goals are decided in a wave depends on the machine, so what is kept is bounded, too.
attack("large goals undecided", above=96, server=SMALL, memory=16 * MIB, frame=MAX_FRAME)(
    partial(large_goals, action="slow", goals=30, size=4 * MIB)
)
attack(
    "large goals undecided over many",
    above=160,
    server=SMALL,
    memory=16 * MIB,
    total_memory=32 * MIB,
    frame=MAX_FRAME,
)(partial(large_goals_over_many, action="slow", size=4 * MIB))
attack("large goals of 15 MiB undecided", above=320, long=True, server=SMALL, frame=MAX_FRAME)(
    partial(large_goals_over_many, action="slow", size=15 * MIB)
)
attack(
    "large goals while authorize waits",
    above=96,
    server=SMALL,
    memory=16 * MIB,
    frame=MAX_FRAME,
    authorize="later",
    wire={"tokens": {"honest": "honest", "hostile": "hostile"}},
)(partial(large_goals, action="echo", goals=30, size=4 * MIB))
attack("large goals accepted", above=96, server=SMALL, frame=MAX_FRAME)(
    partial(large_goals, action="hold", goals=30, size=4 * MIB)
)
# At most six copies are held at once: the result that is being written, one that is kept, and of
# the goal that arrives the frame, the payload, the decoded value, and, since its client has no
# types, the value that is compared with the schema. They are 90 MiB.
attack("large goals at once", above=96, server=SMALL, frame=MAX_FRAME)(
    partial(large_goals, action="echo", goals=20, size=15 * MIB)
)


@attack("large results", above=96, server=SMALL)
async def large_results(target: Target) -> None:
    goal = GROW.goal.encode(Sized(MIB))
    async with target.dial() as raw:
        for _ in range(60):
            id = next(raw.ids)
            await raw.say(sending(id, "grow", goal), Received(id))
        await raw.fence()


@attack("large results unread", above=96, server=SMALL)
async def large_results_unread(target: Target) -> None:
    goal = GROW.goal.encode(Sized(MIB))
    async with target.dial(reads=False) as raw:
        await raw.say(*(sending(id, "grow", goal) for id in range(1, 200)))
        await anyio.sleep(0.3)


async def large_feedback(target: Target, credit: int | None, count: int) -> None:
    async with target.dial() as raw:
        ids = [next(raw.ids) for _ in range(10)]
        await raw.say(*(sending(id, "ticker", ticking(0.0, MIB, count), credit) for id in ids))
        await anyio.sleep(0.5)
        await raw.say(CancelGoals(next(raw.ids), "ticker", None, None))
        await raw.fence()


# Without credit it is remembered for the client.
attack("large feedback unread", above=96, server=SMALL)(
    partial(large_feedback, credit=0, count=2**31)
)
attack("large feedback unfollowed", above=96, server=SMALL)(
    partial(large_feedback, credit=None, count=300)
)


# Texts that reach errors and the log


async def texts(target: Target, size: int) -> None:
    """Send goals whose text comes back in an error or in the log."""
    text = FORGED + "x" * size
    goals = {
        "fail": msgspec.msgpack.encode(text),
        "picky": msgspec.msgpack.encode(text),
        "strict": msgspec.msgpack.encode({text: 1}),
        "echo": msgspec.msgpack.encode({text: {text: msgspec.Raw(b"\xc1")}}),
    }
    async with target.dial() as raw:
        for action, goal in goals.items():
            for _ in range(3 if size > MIB else 50):
                await raw.say(sending(next(raw.ids), action, goal))
            await raw.fence()


attack("forged texts")(partial(texts, size=0))
attack("texts of 10 MB", above=128, frame=MAX_FRAME)(partial(texts, size=10_000_000))


async def unknown_actions(target: Target, size: int) -> None:
    async with target.dial() as raw:
        for _ in range(5):
            name = FORGED + "x" * size
            await raw.say(sending(next(raw.ids), name, b"\x01"))
            await raw.say(CancelGoals(next(raw.ids), name, goal_id(), None))
        await raw.fence()


attack("forged names of actions")(partial(unknown_actions, size=0))
attack("names of actions of 10 MB", above=128, frame=MAX_FRAME)(
    partial(unknown_actions, size=10_000_000)
)


async def goodbyes(target: Target, size: int) -> None:
    for _ in range(5):
        async with target.dial() as raw:
            await raw.say(Goodbye(FORGED + "x" * size))
            await raw.ended()


attack("forged goodbyes")(partial(goodbyes, size=0))
attack("goodbyes of 10 MB", above=128, frame=MAX_FRAME)(partial(goodbyes, size=10_000_000))


# Bombs of MessagePack, as messages and as goals

BOMBS = {
    "lists in lists": b"\x91" * 1_000_000,
    "maps in maps": b"\x81\xa1a" * 500_000,
    "a declared list of 2^32": b"\xdd\xff\xff\xff\xff",
    "a declared map of 2^32": b"\xdf\xff\xff\xff\xff",
    "a declared text of 2^32": b"\xdb\xff\xff\xff\xff",
    "a declared extension of 2^32": b"\xc9\xff\xff\xff\xff\x01",
    "an extension": b"\xc7\x04\x01abcd",
    "a bad code": b"\xc1",
    "text that is not UTF-8": b"\x81\xa2\xff\xfe\x01",
    "an empty frame": b"",
}


async def bombs(target: Target) -> None:
    async with target.dial() as raw:
        for bomb in BOMBS.values():
            for action in ("echo", "fibonacci", "forever", "nothing"):
                await raw.say(sending(next(raw.ids), action, b"\x81\xa1a" + bomb))
                await raw.say(sending(next(raw.ids), action, bomb))
        await raw.fence()
    for bomb in BOMBS.values():
        async with target.dial() as raw:
            await raw.write(header(len(bomb)) + bomb)
            await raw.ended()


attack("bombs", above=96)(bombs)


async def many_values(target: Target, action: str, size: int) -> None:
    """Send goals of as many small values as a frame takes: they cost the most to decode."""
    size = target.size(size // 2, size)
    goal = b"\x81\xa1a\xdd" + size.to_bytes(4, "big") + b"\x90" * size
    async with target.dial() as raw:
        for _ in range(3):
            await raw.say(sending(next(raw.ids), action, goal))
        await raw.fence()


attack("goals of a million values, unknown field", above=128)(
    partial(many_values, action="fibonacci", size=LARGE)
)
attack("goals of a million values", above=1500, long=True)(
    partial(many_values, action="echo", size=LARGE)
)


@attack("answers unread", above=96)
async def answers_unread(target: Target) -> None:
    async with target.dial_many(20, reads=False) as raws:
        listing = packed(*map(ListActions, range(1, 900)))
        await each(raws, lambda raw: raw.write(listing))
        await anyio.sleep(0.3)
        await each(raws, lambda raw: raw.say(*map(Close, range(1, 900))))
