"""Signals that end a verb, with and without the event loop's receiver of them."""

from __future__ import annotations

import signal
from collections.abc import Callable
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import pytest

from fibaction.cli.process.signals import MOST_WAITING_SIGNALS, ReceivedSignals, handle_with
from tests.support.processes import PATIENCE


@pytest.fixture(params=["as Unix", "as Windows"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The event loop has a receiver of signals, or has none."""

    def not_there(*_: object) -> Any:
        raise NotImplementedError

    if request.param == "as Windows":
        monkeypatch.setattr("anyio.open_signal_receiver", not_there)


@pytest.mark.asyncio
@pytest.mark.usefixtures("system")
async def test_each_signal_is_received_and_its_handler_is_called_at_once() -> None:
    told: list[int] = []
    received = ReceivedSignals(lambda number, _: told.append(number))
    with anyio.fail_after(PATIENCE), received:
        for number in (SIGINT, SIGTERM):
            signal.raise_signal(number)
            assert told[-1] == number  # before the event loop has its turn
            await received.next()

    assert told == [SIGINT, SIGTERM]


@pytest.mark.asyncio
@pytest.mark.usefixtures("system")
async def test_behind_the_block_the_handlers_are_as_before() -> None:
    before = signal.getsignal(SIGTERM)
    with ReceivedSignals(lambda *_: None):
        assert signal.getsignal(SIGTERM) != before
    assert signal.getsignal(SIGTERM) == before


@pytest.mark.asyncio
async def test_signals_that_nothing_takes_need_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    def not_there(*_: object) -> Any:
        raise NotImplementedError

    monkeypatch.setattr("anyio.open_signal_receiver", not_there)
    told: list[int] = []
    received = ReceivedSignals(lambda number, _: told.append(number))
    with received:
        for _ in range(MOST_WAITING_SIGNALS + 3):
            signal.raise_signal(SIGINT)
        await anyio.wait_all_tasks_blocked()
        for _ in range(MOST_WAITING_SIGNALS):
            await received.next()
        with anyio.move_on_after(0) as none_left:
            await received.next()

    assert none_left.cancelled_caught
    assert len(told) == MOST_WAITING_SIGNALS + 3


def test_all_signals_get_the_handler() -> None:
    before: list[Any] = [signal.getsignal(SIGINT), signal.getsignal(SIGTERM)]
    handler: Callable[[int, object], None] = lambda *_: None  # noqa: E731
    try:
        handle_with(handler)
        assert signal.getsignal(SIGINT) is signal.getsignal(SIGTERM) is handler
    finally:
        for number, restored in zip((SIGINT, SIGTERM), before, strict=True):
            signal.signal(number, restored)
