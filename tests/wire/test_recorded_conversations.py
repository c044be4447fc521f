"""Clients of earlier releases, whose recorded bytes are sent to a server of this one over TCP.

The answers are those that were recorded, as far as such a client reads them: a message may have
more fields at its end than it had then. Times and addresses of clients are others each time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import serve
from fibaction.wire.frames import framed
from fibaction.wire.messages import VERSION, FeedbackBatch, Ping, StatusChanged
from tests.wire.record_conversation import RECORDED, frames, record, server

pytestmark = pytest.mark.anyio

PING, STATUS, BATCH = (each.__struct_config__.tag for each in (Ping, StatusChanged, FeedbackBatch))
FEEDBACK = 36
TIME = 10**18
"""The least number that is a time in nanoseconds."""


def read(frame: bytes) -> Iterator[Any]:
    """Yield a message as a list, with the same items each time.

    Feedback may come alone or in batches, and a status that lasts for a moment may be left out.
    """
    match msgspec.msgpack.decode(frame):
        case [int(tag), *_] if tag in (PING, STATUS):
            pass
        case [int(tag), call, int(number), [*payloads], *_] if tag == BATCH:
            yield from ([FEEDBACK, call, number + n, one] for n, one in enumerate(payloads))
        case message:
            yield _same(message)


def _same(item: Any) -> Any:
    match item:
        case list():
            return [_same(one) for one in item]
        case int() if item >= TIME:
            return "a time"
        case str():
            return re.sub(r"^127\.0\.0\.1:\d+$", "an address", item)
        case _:
            return item


def is_understood(new: Any, old: Any) -> bool:
    """Return whether who knows the old message reads the same in the new one."""
    if isinstance(new, list) and isinstance(old, list):
        return len(new) >= len(old) and all(map(is_understood, new, old))
    return type(new) is type(old) and bool(new == old)


def test_a_conversation_of_this_version_is_recorded() -> None:
    assert RECORDED.joinpath(f"version_{VERSION}.txt").exists()


def recorded(path: Path) -> list[str]:
    """Return the lines of a conversation."""
    return path.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("path", sorted(RECORDED.iterdir()), ids=lambda path: path.stem)
async def test_a_client_of_an_earlier_release_hears_what_it_has_heard(path: Path) -> None:
    lines = recorded(path)
    assert len(lines) > 20
    with anyio.fail_after(20):
        async with serve(server(), "tcp://127.0.0.1:0") as (url,):
            port = int(url.rpartition(":")[2])
            async with await anyio.connect_tcp("127.0.0.1", port) as stream:
                answers = frames(stream)
                heard: list[Any] = []
                for line in lines:
                    side, _, text = line.partition(" ")
                    frame = bytes.fromhex(text)
                    if side == ">":
                        await stream.send(framed([frame]))
                        continue
                    for expected in read(frame):
                        while not heard:
                            heard += read(await anext(answers))
                        assert is_understood(heard.pop(0), expected), line
                # After its goodbye the server closes the connection.
                assert [one async for frame in answers for one in read(frame)] == []
    assert not heard


async def test_a_client_of_this_release_says_what_was_recorded() -> None:
    both = [recorded(RECORDED / f"version_{VERSION}.txt"), await record()]

    old, new = (
        [msgspec.msgpack.decode(bytes.fromhex(line[2:])) for line in lines if line[0] == ">"]
        for lines in both
    )
    assert len(new) == len(old)
    # The first has an owner, which each client draws anew.
    assert all(map(is_understood, new[1:], old[1:]))


def test_a_field_that_is_gone_or_another_is_found() -> None:
    assert is_understood([36, 1, [b"x", 5]], [36, 1, [b"x"]])
    assert not is_understood([36, 1], [36, 1, None])
    assert not is_understood([36, 1, True], [36, 1, 1])
    assert not is_understood([36, [2]], [36, [1]])
