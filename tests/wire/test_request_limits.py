"""The limits of what one connection may ask of the server at the same time."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction.wire.messages import (
    CancelAnswered,
    CancelGoals,
    Close,
    Ended,
    Failed,
    Follow,
    Following,
    Received,
    Rejected,
    Why,
)
from fibaction.wire.settings import Limits
from tests import fibonacci as fib
from tests.wire.ends import (
    ANN,
    BOB,
    A,
    B,
    feedback,
    follow,
    held,
    kinds,
    running,
    send,
    serving,
)

pytestmark = pytest.mark.anyio

OFTEN = (
    f"too much at once: this connection follows goal {A.hex()} already 2 times, which is the limit"
)


# How often one connection may follow one goal


async def test_a_connection_follows_one_goal_so_often_and_no_more() -> None:
    async with serving(held(), limits=Limits(follows=2)) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1)
        assert kinds(await client.ask_all(follow(None, own=False, request=2))) == [Following]
        again = follow(None, own=False, request=3)
        assert await client.ask(again, Failed) == Failed(3, Why.LIMIT, OFTEN)
        assert await client.ask(send(4), Rejected) == Rejected(4, OFTEN)
        await client.send(5, B)
        assert kinds(await other.ask_all(follow(None, own=False))) == [Following]


@pytest.mark.parametrize("own", [True, False])
async def test_a_goal_can_be_followed_again_once_a_call_has_ended(own: bool) -> None:
    async with serving(held(), limits=Limits(follows=2)) as served:
        client = await served.greet()
        await client.send(1)
        for request in range(2, 9):
            assert kinds(await client.ask_all(follow(None, own=False, request=request)))
            await client.say(Received(request))
        failed = await client.ask(Follow(9, "fibonacci", B, None, own, 1), Failed)
        assert failed.why == Why.UNKNOWN_GOAL
        await client.ask_all(CancelGoals(10, "fibonacci", A, None))
        await client.say(Received(1))
        for request in range(11, 20):
            heard = await client.ask_all(follow(None, own=own, request=request))
            assert kinds(heard) == [Following, Ended]
            await client.say(Received(request))


async def test_a_goal_that_is_being_decided_upon_counts_for_each_time_it_was_sent() -> None:
    decided = anyio.Event()

    async def on_goal(_goal: Any) -> None:
        await decided.wait()

    async with serving(
        running(*feedback(1), fib.Result([]), on_goal=on_goal), limits=Limits(follows=2)
    ) as served:
        client = await served.greet()
        assert await client.ask_all(*map(send, range(1, 4))) == [Rejected(3, OFTEN)]
        decided.set()
        heard = await client.hear_by_id()
        assert {kinds(messages)[-1] for messages in heard.values()} == {Ended}
        assert set(heard) == {1, 2}


async def test_a_call_that_wants_the_end_only_counts_until_the_end() -> None:
    async with serving(held(), limits=Limits(follows=2)) as served:
        client = await served.greet()
        await client.send(1)
        await client.ask_all(follow(None, own=False, request=2), Close(2), Close(1))
        assert (await client.ask(follow(None, request=3), Failed)).why == Why.LIMIT
        await client.say(CancelGoals(4, "fibonacci", A, None))
        heard = await client.hear_by_id()
        assert kinds(heard[2]) == [Ended]
        assert kinds(heard[4]) == [CancelAnswered]
        await client.ask(follow(None, own=False, request=5), Following)
