"""`fibaction_transports.web.http.exchange`: answers that clients take slowly."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import FrameMemory
from fibaction.words.errors import ConnectionLost
from fibaction_transports.web.http.exchange import Exchange

pytestmark = pytest.mark.anyio

SCOPE = {"method": "GET", "path": "/", "headers": []}


async def receive() -> Any:
    await anyio.sleep_forever()


async def deaf(message: Any) -> None:
    if message["type"] == "http.response.body":
        await anyio.sleep_forever()


async def test_a_parameter_may_come_several_times() -> None:
    exchange = Exchange(SCOPE | {"query_string": b"a=1&b=&a=2%2B"}, receive, deaf)

    assert exchange.parameters("a") == ["1", "2+"]
    assert exchange.parameter("a") == "2+"
    assert (exchange.parameters("b"), exchange.parameter("b")) == ([""], "")
    assert (exchange.parameters("c"), exchange.parameter("c")) == ([], None)


async def test_a_large_answer_goes_in_pieces() -> None:
    sent: list[bytes] = []

    async def send(message: Any) -> None:
        sent.append(message.get("body", b""))

    await Exchange(SCOPE, receive, send).answer(200, bytes(200_000))
    assert max(map(len, sent)) == 2**16
    assert sum(map(len, sent)) == 200_000


async def test_a_large_answer_counts_while_it_is_written() -> None:
    budget = ByteBudget(300_000)
    counted: list[int] = []

    async def send(message: Any) -> None:
        if message["type"] == "http.response.body":
            counted.append(budget.used)

    await Exchange(SCOPE, receive, send, 60.0, FrameMemory(budget)).answer(200, bytes(200_000))
    assert min(counted) > 0
    assert budget.used == 0


async def test_the_largest_answer_is_given_up_when_all_together_are_too_large() -> None:
    budget = ByteBudget(300_000)
    memory = FrameMemory(budget)
    large, other = (Exchange(SCOPE, receive, deaf, 60.0, memory) for _ in range(2))

    async def write_other() -> None:
        await anyio.wait_all_tasks_blocked()
        await other.answer(200, bytes(200_000))

    with anyio.fail_after(20):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(write_other)
            with pytest.raises(ConnectionLost, match="too long for a large answer at a busy"):
                await large.answer(200, bytes(300_000))
            assert 0 < budget.used < 200_000
            tasks.cancel_scope.cancel()
    assert budget.used == 0


async def test_an_answer_that_is_larger_than_all_may_be_is_given_up() -> None:
    exchange = Exchange(SCOPE, receive, deaf, 60.0, FrameMemory(ByteBudget(1000)))
    with pytest.raises(ConnectionLost, match="at a busy server"):
        await exchange.answer(200, bytes(100_000))
