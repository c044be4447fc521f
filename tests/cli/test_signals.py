"""Signals: the first, the second, and a signal that ends what would continue for ever."""

from __future__ import annotations

import os
import signal
from signal import SIGINT, SIGTERM

import anyio
import anyio.lowlevel
import pytest

from fibaction.cli import signals
from tests.processes import PATIENCE


@pytest.mark.asyncio
async def test_the_second_signal_ends_it_if_it_is_not_the_first_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[object] = []
    monkeypatch.setattr(signals, "end_by", told.append)
    with anyio.fail_after(PATIENCE):
        async with signals.stop_signals() as stop:
            os.kill(os.getpid(), SIGINT)
            await stop.wait()
            os.kill(os.getpid(), SIGTERM)
            await anyio.sleep(signals.SAME_SIGNAL)  # it is the time that is tested
            assert told == []
            os.kill(os.getpid(), SIGTERM)

    assert told == [SIGTERM]


@pytest.mark.asyncio
async def test_the_second_signal_ends_it_also_while_the_event_loop_is_blocked_and_behind_the_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[object] = []
    monkeypatch.setattr(signals, "end_by", told.append)
    monkeypatch.setattr(signals, "SAME_SIGNAL", 0)
    async with signals.stop_signals() as stop:
        os.kill(os.getpid(), SIGTERM)
        await stop.wait()
        await anyio.wait_all_tasks_blocked()
        signal.raise_signal(SIGINT)  # and the event loop does not get its turn
        assert told == [SIGINT]
    signal.raise_signal(SIGINT)
    assert told == [SIGINT, SIGINT]


@pytest.mark.asyncio
async def test_without_a_signal_the_ways_to_end_are_as_before() -> None:
    before = signal.getsignal(SIGTERM)
    async with signals.stop_signals():
        assert signal.getsignal(SIGTERM) != before
    assert signal.getsignal(SIGTERM) == before


def test_the_end_by_a_signal_is_that_of_a_process_that_does_not_handle_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, int]] = []
    before = signal.getsignal(SIGTERM)
    monkeypatch.setattr(os, "kill", lambda *arguments: sent.append(arguments))
    try:
        signals.end_by(SIGTERM)
        assert signal.getsignal(SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(SIGTERM, before)

    assert sent == [(os.getpid(), SIGTERM)]


@pytest.mark.asyncio
@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
async def test_a_signal_ends_what_would_go_on_for_ever(number: signal.Signals) -> None:
    async def body() -> None:
        signal.raise_signal(number)
        await anyio.sleep_forever()

    with anyio.fail_after(5):
        assert await signals.until_interrupted(body)


@pytest.mark.asyncio
async def test_what_ends_by_itself_was_not_interrupted() -> None:
    assert not await signals.until_interrupted(lambda: anyio.lowlevel.checkpoint())
