"""Any bytes, and any messages in any order: they end their own session at most, in one line."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any, get_args

import anyio
import pytest
from anyio.abc import ByteStream
from hypothesis import given
from hypothesis import strategies as st

from fibaction.server import ActionServer
from fibaction.wire.channel import StreamChannel
from fibaction.wire.codec import encode
from fibaction.wire.frames import framed
from fibaction.wire.messages import (
    VERSION,
    CancelGoals,
    Ended,
    Feedback,
    FromClient,
    Goodbye,
    Hello,
    SendGoal,
    WatchStatus,
    past_fields,
)
from fibaction.wire.settings import Limits
from fibaction.words.errors import ConnectionLost
from fibaction.words.goal_query import PastPage
from fibaction.words.goals import GoalID
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.wire import memory
from tests.wire.ends import ANN, BOB, SUCCEEDED, A, B, C, Client, Served, serving
from tests.wire.memory import LONG, Running, logged, settled

LIMITS = Limits(goals=3, requests=4, memory=1000, frame=1024, queue=5000)
BACKENDS = pytest.mark.parametrize("backend", ["asyncio", "trio"])


class Chunks(ByteStream):
    """Bytes that arrive in pieces; what is sent is lost."""

    def __init__(self, chunks: list[bytes]) -> None:
        self._chunks = chunks

    async def receive(self, max_bytes: int = 65536) -> bytes:
        await anyio.lowlevel.checkpoint()
        if not self._chunks:
            raise anyio.EndOfStream
        return self._chunks.pop(0)

    async def send(self, item: bytes) -> None:
        await anyio.lowlevel.checkpoint()

    async def send_eof(self) -> None:
        raise AssertionError

    async def aclose(self) -> None:
        await anyio.lowlevel.checkpoint()


@asynccontextmanager
async def beside_a_good_client() -> AsyncGenerator[Served, None]:
    """A server for a bad client; in the end, its good client is as well served as before."""
    server = ActionServer(FIBONACCI, fib.fibonacci, feedback_window=4, shutdown_timeout=0.5)
    async with serving(server, limits=LIMITS) as served:
        good = await served.greet(b"", name="the good one")
        with logged() as lines:
            yield served
        assert one_line(lines, "the bad one").strip(": ")
        await good.send(1, GoalID.random())
        for _ in range(2):
            await good.hear(Feedback)
        assert (await good.hear(Ended)).status == SUCCEEDED
        assert await good.is_served()


def one_line(lines: list[logging.LogRecord], peer: str) -> str:
    """The one line that tells of a peer, which it names once; without the name."""
    (line,) = [line for line in lines if peer in line.getMessage()]
    assert line.exc_info is None
    before, after = line.getMessage().split(peer)
    return before + after


numbers = st.integers(0, 4) | st.just(2**63 - 1)
goal_ids = st.sampled_from([bytes(16), A, B, C, bytes([4] * 16)])
goals = st.integers(-1, 9).map(lambda order: FIBONACCI.goal.encode(fib.Goal(order)))
credits_ = st.sampled_from([0, 1, 2, 2**31 - 1])
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "action": st.sampled_from(["fibonacci", "fibonacci", "swim", ""]),
    "after": st.none() | numbers,
    "count": credits_,
    "credit": st.none() | credits_,
    "goal": goals | st.binary(max_size=400),
    "goal_id": goal_ids,
    "heartbeat": st.just(LONG),
    "id": numbers,
    "most": credits_,
    "own": st.booleans(),
    "past": st.sampled_from([None, past_fields(PastPage())]),
    "reason": st.text(max_size=3),
    "session": st.sampled_from([b"", ANN, BOB]),
    "stamp": st.none() | numbers,
    "timeout": st.sampled_from([None, 5e-324, 1.0, 1e9]),
    "token": st.text(max_size=3),
    "version": st.sampled_from([1, 2]),
    "why": st.integers(0, 9),
}
"""What the fields of messages may be, of whatever message; others have their default."""
OTHERS: dict[type, dict[str, Any]] = {
    CancelGoals: {"goal_id": st.none() | goal_ids},
    WatchStatus: {"credit": credits_},
}


def any_of(kind: Any) -> st.SearchStrategy[Any]:
    fields = FIELDS | OTHERS.get(kind, {})
    names = set(kind.__struct_fields__)
    return st.builds(kind, **{name: fields[name] for name in fields if name in names})


MESSAGES = {kind: any_of(kind) for kind in get_args(FromClient)}
requests = st.one_of(
    *(strategy for kind, strategy in MESSAGES.items() if kind not in (Hello, Goodbye))
)
sequences = st.lists(requests | requests | st.one_of(*MESSAGES.values()), max_size=30)


def chopped(data: bytes, cuts: list[int]) -> list[bytes]:
    places = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
    return [data[one:other] for one, other in pairwise(places)]


hello = encode(Hello(VERSION, LONG, session=ANN))
valid = MESSAGES[SendGoal].map(encode) | requests.map(encode)
almost = st.builds(
    lambda frame, place, byte: frame[:place] + bytes([byte]) + frame[place + 1 :],
    valid,
    st.integers(0, 20),
    st.integers(0, 255),
)
"""A message with one byte changed."""
streams = st.binary(max_size=60) | st.builds(
    lambda frames, rest: framed([hello, *frames]) + rest,
    st.lists(valid | almost | st.binary(max_size=20), max_size=10),
    st.binary(max_size=10),
)


@BACKENDS
@given(data=streams, cuts=st.lists(st.integers(0, 300), max_size=10))
def test_any_bytes_end_their_own_session_only(backend: str, data: bytes, cuts: list[int]) -> None:
    async def check() -> None:
        async with beside_a_good_client() as served:
            stream = Chunks(chopped(data, cuts))
            with anyio.fail_after(5):
                await served.wire.serve(
                    StreamChannel(stream, "the bad one", served.wire.new_reader())
                )

    anyio.run(check, backend=backend)


@BACKENDS
@given(messages=sequences, batches=st.integers(1, 30), reads=st.booleans())
def test_any_messages_in_any_order_harm_their_own_session_at_most(
    backend: str, messages: list[Any], batches: int, reads: bool
) -> None:
    async def check() -> None:
        async with beside_a_good_client() as served:
            end, other = memory.pair("the bad one")
            async with Running(lambda: served.wire.serve(end)) as session:
                if not reads:
                    other.stop_reading()
                bad = Client(other)
                try:
                    await bad.say(Hello(VERSION, LONG, session=ANN))
                    for start in range(0, len(messages), batches):
                        await bad.say(*messages[start : start + batches])
                        await settled()
                except ConnectionLost:
                    pass
                other.go_on_reading()
                other.cut()
                await session.answer()

    anyio.run(check, backend=backend)
