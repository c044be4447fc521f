"""Signals that end a verb, with and without the event loop's receiver of them."""

from __future__ import annotations

import signal
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import pytest

from fibaction.cli.process.signals import MOST_WAITING_SIGNALS, ReceivedSignals
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
