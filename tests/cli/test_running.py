"""What runs until a signal comes: the first signal, the second, and the log."""

from __future__ import annotations

import logging
import os
import re
import signal
from signal import SIGINT, SIGTERM
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction import ActionInfo
from fibaction.cli import running
from tests.cli.served import counter
from tests.processes import PATIENCE


@pytest.mark.asyncio
async def test_the_second_signal_ends_it_if_it_is_not_the_first_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[object] = []
    monkeypatch.setattr(running, "end_by", told.append)
    with anyio.fail_after(PATIENCE):
        async with running.stop_signals(lambda: told.append("at once")) as stop:
            os.kill(os.getpid(), SIGINT)
            await stop.wait()
            os.kill(os.getpid(), SIGTERM)
            await anyio.sleep(running.SAME_SIGNAL)  # it is the time that is tested
            assert told == []
            os.kill(os.getpid(), SIGTERM)

    assert told == ["at once", SIGTERM]


@pytest.mark.asyncio
async def test_the_second_signal_ends_it_also_while_nothing_else_is_done_and_behind_the_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[object] = []
    monkeypatch.setattr(running, "end_by", told.append)
    monkeypatch.setattr(running, "SAME_SIGNAL", 0)
    async with running.stop_signals() as stop:
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
    async with running.stop_signals():
        assert signal.getsignal(SIGTERM) != before
    assert signal.getsignal(SIGTERM) == before


def test_the_end_by_a_signal_is_that_of_a_process_that_does_not_handle_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, int]] = []
    before = signal.getsignal(SIGTERM)
    monkeypatch.setattr(os, "kill", lambda *arguments: sent.append(arguments))
    try:
        running.end_by(SIGTERM)
        assert signal.getsignal(SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(SIGTERM, before)

    assert sent == [(os.getpid(), SIGTERM)]


def test_names_are_shown_as_those_of_ros() -> None:
    assert running.names_of([counter("arm/pick"), counter("/count")]) == "/arm/pick, /count"


def test_names_from_elsewhere_are_cleaned() -> None:
    far: Any = SimpleNamespace(info=ActionInfo("a\x1b"))

    assert running.names_of([far]) == "/a\\x1b"


def test_what_happens_is_logged_with_its_time_and_afterwards_as_before(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, files = logging.getLogger(), logging.getLogger("watchfiles")
    monkeypatch.setattr(files, "level", logging.NOTSET)
    before = (root.level, root.handlers[:])
    with running.logging_to_stderr():
        logging.getLogger("fibaction.any").info("it is heard of\x1b")
        files.info("1 change detected")
        (line,) = capsys.readouterr().err.splitlines()

    assert (root.level, root.handlers, files.level) == (*before, logging.NOTSET)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} it is heard of\\x1b", line)
