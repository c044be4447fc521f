"""Attacks with connections: storms, resets, half-open and slow ones, and games with `Hello`."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import Any

import anyio

from fibaction.wire.frames import header
from fibaction.wire.messages import AwaitServer, Follow, Hello, Ping
from tests.hostile.attack import MOST, attack, goal_id, sending
from tests.hostile.floods import SHORT, TERMS
from tests.hostile.raw_client import Lost, Raw, Target, each, packed


@attack("a storm of connections")
async def storm(target: Target) -> None:
    async def come_and_go() -> None:
        for _ in range(15):
            with suppress(*Lost):
                await (await anyio.connect_tcp(target.host, target.port)).aclose()

    async with anyio.create_task_group() as tasks:
        for _ in range(20):
            tasks.start_soon(come_and_go)


async def resets(target: Target, *, hello: bool) -> None:
    """Send half of a message, and reset the connection."""
    for _ in range(60):
        async with target.dial(hello=hello, session=goal_id()) as raw:
            data = packed(*(sending(id, "fibonacci", TERMS) for id in range(1, 20)))
            await raw.write(data[:-7])
            await raw.reset()


attack("resets")(partial(resets, hello=True))
attack("resets before hello")(partial(resets, hello=False))


@attack("half-closed connections", above=96)
async def half_closed(target: Target) -> None:
    for _ in range(30):
        async with target.dial() as raw:
            await raw.say(*(sending(id, "fibonacci", TERMS) for id in range(1, 20)))
            await raw.close_half()
            await raw.ended()


GARBAGE = {
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),
    "HTTP": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    "empty frames": bytes(4000),
    "a message that is none": header(200) + bytes(range(200)),
}


@attack("garbage")
async def garbage(target: Target) -> None:
    async def one(raw: Raw, data: bytes) -> None:
        await raw.write(data)
        await raw.ended()

    for data in GARBAGE.values():
        async with target.dial_many(20, hello=False) as raws:
            await each(raws, partial(one, data=data))


async def dribble(target: Target, *, hello: bool) -> None:
    """Send a message byte by byte, on many connections."""
    data = header(4000) + bytes(100)

    async def one(raw: Raw) -> None:
        for byte in data[: target.size(10, 60)]:
            await raw.write(bytes([byte]))
            await anyio.sleep(0.05)

    async with target.dial_many(target.size(100, 900), hello=hello) as raws:
        await each(raws, one)


attack("slow frames")(partial(dribble, hello=True))
attack("slow hellos", handshake=0.3)(partial(dribble, hello=False))


@attack("one session on many connections", above=96)
async def superseded(target: Target) -> None:
    """Take a session over from connection to connection, each of which has goals."""
    session = goal_id() * 2
    for _ in range(10):
        async with target.dial_many(10, session=session) as raws:
            await each(
                raws, lambda raw: raw.say(*(sending(id, "forever", SHORT, 0) for id in range(1, 9)))
            )
            await each(raws, lambda raw: raw.fence(2))


@attack("sessions that are guessed")
async def guessed_sessions(target: Target) -> None:
    for _ in range(60):
        async with target.dial(session=goal_id() * 2) as raw:
            await raw.say(Follow(1, "fibonacci", goal_id(), None, True, MOST))
            await raw.fence()


@attack("800 idle connections", above=128)
async def idle_many(target: Target) -> None:
    async def named(raw: Raw) -> None:
        await raw.say(target.hello(session=goal_id() * 2), AwaitServer(1, "fibonacci"))
        await raw.fence()

    async with target.dial_many(target.size(300, 800), hello=False) as raws:
        await each(raws, named)
        for _ in range(20):
            async with target.dial(session=goal_id() * 2) as raw:
                await raw.fence()


HELLOS: dict[str, dict[str, Any]] = {
    "most": {"heartbeat": 3600.0, "session": bytes(32), "max_frame": 2**32 - 1},
    "least": {"heartbeat": 5e-324, "session": b"", "max_frame": 1},
    "of one byte each": {"heartbeat": 60.0, "session": b"", "max_frame": 1},
    "of a short session": {"session": b"x"},
    "of another version": {"version": -(2**63)},
}


@attack("odd hellos")
async def odd_hello(target: Target) -> None:
    for fields in HELLOS.values():
        for _ in range(10):
            async with target.dial(**fields) as raw:
                with suppress(*Lost):
                    await raw.say(*(sending(id, "fibonacci", TERMS) for id in range(1, 20)))
                    await raw.say(Ping())
                    await anyio.sleep(0.01)
    async with target.dial(hello=False) as raw:
        await raw.say(Ping())
        await raw.ended()
    async with target.dial() as raw:
        await raw.say(Hello(1, 1.0))
        await raw.ended()


@attack("heartbeats of a millisecond", above=96)
async def short_heartbeats(target: Target) -> None:
    """Ask for heartbeats as often as the server allows, on many connections."""

    async def one(raw: Raw) -> None:
        for _ in range(target.size(100, 1000)):
            await raw.say(Ping())
            await anyio.sleep(0.003)

    async with target.dial_many(target.size(100, 500), heartbeat=0.001) as raws:
        await each(raws, one)


@attack("wrong tokens", wire={"tokens": {"honest": "honest", **{f"t{n}": "t" for n in range(200)}}})
async def wrong_tokens(target: Target) -> None:
    for _ in range(6):
        async with target.dial_many(20, token="x" * 2000) as raws:
            await each(raws, Raw.ended)
