"""`fibaction serve` ends though threads of executors do not."""

from __future__ import annotations

import os
import threading

import pytest

from fibaction.cli.process.signals import LastSeconds


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The exit codes of this process, if it ended."""
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.setattr("logging.shutdown", lambda: None)
    return codes


def test_a_process_without_threads_of_its_own_ends_by_itself(ends: list[int]) -> None:
    with LastSeconds(60, 3) as last:
        last.begin()
    last._timer.join()
    assert ends == []


def test_a_block_that_takes_too_long_is_the_end(ends: list[int]) -> None:
    with LastSeconds(0.01, 3) as last:
        last.begin()
        last._timer.join()
        assert ends == [3]


def test_a_thread_that_does_not_end_is_not_waited_for(
    ends: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    go = threading.Event()
    thread = threading.Thread(target=go.wait)
    with LastSeconds(0.01, 3) as last:
        thread.start()
        last.begin()
    last._timer.join()
    go.set()
    thread.join()
    assert ends == [3]
    assert "without its threads" in caplog.text
