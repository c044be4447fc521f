"""Signals: the first, the second, one that ends what continues forever; and the last seconds."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
import threading
import tty
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from fibaction.cli.process import signals
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.process.signals import MOST_WAITING_SIGNALS, LastSeconds, ReceivedSignals
from tests.support.processes import PATIENCE, ended, lines_until


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

    with anyio.fail_after(30):
        assert await signals.until_interrupted(body)


@pytest.mark.asyncio
async def test_what_ends_by_itself_was_not_interrupted() -> None:
    assert not await signals.until_interrupted(lambda: anyio.lowlevel.checkpoint())


# While something computes

COMPUTING = """
import anyio
from fibaction.cli.process.exit_codes import run
from fibaction.cli.process.signals import stop_signals, until_interrupted, SignalReceiver

async def compute(shielded=False):
    print("computing", flush=True)
    while True:
        pass

async def verb():
    await compute()

async def watch():
    await until_interrupted(compute)

async def send():
    with SignalReceiver(lambda: print("left running", flush=True)):
        await compute()

async def serve():
    async with stop_signals():
        await compute()
"""


def computing(verb: str) -> list[str]:
    return [sys.executable, "-c", f"{COMPUTING}\nrun({verb}, uvloop={verb == 'serve'})"]


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
@pytest.mark.parametrize("verb", ["verb", "watch", "send"])
def test_one_signal_ends_a_verb_that_computes(verb: str, number: signal.Signals) -> None:
    process = subprocess.Popen(computing(verb), stdout=subprocess.PIPE, text=True)
    lines_until("computing", process)
    process.send_signal(number)

    code, out, _ = ended(process)

    assert code == (-SIGTERM if (verb, number) == ("verb", SIGTERM) else ExitCode.INTERRUPTED)
    assert out == ("left running\n" if verb == "send" else "")


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_the_second_signal_ends_a_server_that_computes(number: signal.Signals) -> None:
    process = subprocess.Popen(computing("serve"), stdout=subprocess.PIPE, text=True)
    lines_until("computing", process)
    while process.poll() is None:  # the first one at once, the second after `SAME_SIGNAL`
        process.send_signal(number)
        try:
            process.wait(signals.SAME_SIGNAL)
        except subprocess.TimeoutExpired:
            continue

    assert ended(process).code == -number


@pytest.mark.asyncio
async def test_a_signal_that_is_taken_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    alarms: list[float] = []
    monkeypatch.setattr(signal, "setitimer", lambda _, seconds: alarms.append(seconds))
    monkeypatch.setattr(signal, "getitimer", lambda _: alarms[-1:] or [0])
    with signals.SignalReceiver() as receiver:
        signal.raise_signal(SIGTERM)
        signal.raise_signal(SIGINT)
        await receiver.next()

    assert alarms == [signals.GRACE, 0, 0]


@pytest.mark.asyncio
@pytest.mark.parametrize("has_states", [True, False])
async def test_the_exit_restores_the_terminal(
    has_states: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as terminal:
        for name, stream in (("stdin", terminal), ("stdout", None), ("stderr", terminal)):
            monkeypatch.setattr(sys, f"__{name}__", stream)
        before = termios.tcgetattr(terminal)
        if not has_states:  # as on Windows
            monkeypatch.setitem(sys.modules, "termios", None)
        with signals.SignalReceiver(lambda: codes.append(0)):
            if has_states:
                tty.setraw(terminal)
            signal.raise_signal(signal.SIGALRM)
        assert termios.tcgetattr(terminal) == before
        monkeypatch.undo()
    written = os.read(master, 1000)
    os.close(master)

    assert codes == [0, ExitCode.INTERRUPTED]
    assert written.endswith(b"\x1b[?25h")


@pytest.mark.asyncio
async def test_the_exit_needs_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, f"__{name}__", None)
    with signals.SignalReceiver():
        signal.raise_signal(signal.SIGALRM)

    assert codes == [ExitCode.INTERRUPTED]


@pytest.mark.asyncio
async def test_without_a_timer_of_signals_the_next_one_ends_what_computes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.delattr(signal, "SIGALRM")
    with signals.SignalReceiver() as receiver:
        signal.raise_signal(SIGINT)
        await receiver.next()
        signal.raise_signal(SIGINT)
        assert codes == []
        signal.raise_signal(SIGINT)  # the one before was not taken

    assert codes == [ExitCode.INTERRUPTED]


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
