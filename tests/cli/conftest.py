"""What the tests of the command line run against, and how they run it.

`url` is where a real server process is, once over TCP and once over a Unix socket; `tcp` is the one
over TCP. `fibaction` runs the command as a process, `terminal` runs it in a pseudo-terminal, and
`invoke` runs it in this process, where coverage sees it.
"""

from __future__ import annotations

import fcntl
import logging
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple, TypeAlias

import pyte
import pytest
from click.testing import CliRunner, Result

from fibaction.cli.app import cli
from fibaction.cli.process import signals
from fibaction.cli.verbs import serve, serve_mcp
from tests.cli.robot_module import MODULE
from tests.support.processes import PATIENCE, Finished, ended, lines_until

Run: TypeAlias = "Callable[..., Finished]"
"""Runs the command with these arguments, `url=`, `input=` and `env=`: see `fibaction`, `here`."""
Start: TypeAlias = "Callable[..., subprocess.Popen[str]]"
"""See `started`."""
Invoke: TypeAlias = "Callable[..., Result]"
"""See `invoke`."""
Open: TypeAlias = "Callable[..., Terminal]"
"""See `terminal`."""

ROOT = Path(__file__).resolve().parents[2]
WARNINGS = ("-W", "error", "-W", "ignore:module 'sre_:DeprecationWarning")
"""Warnings are errors, but for what ROS imports."""


def command(*arguments: str) -> list[str]:
    """The command line of the console script, with Python's warnings as errors."""
    script = Path(sys.executable).with_name("fibaction")
    return [sys.executable, *WARNINGS, str(script), *arguments]


def environment(url: str | None, env: Mapping[str, str] | None = None) -> dict[str, str]:
    """This process's, without what could change how a command behaves, and the server's URL."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("FIBACTION_", "_FIBACTION_"))
        and name not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES", "TERM")
    }
    return {**kept, **({"FIBACTION_URL": url} if url else {}), **(env or {})}


# Servers


class Robot(NamedTuple):
    """A server process: see `tests/cli/robot.py`."""

    process: subprocess.Popen[str]
    tcp: str
    unix: str


StartModule: TypeAlias = "Callable[..., tuple[subprocess.Popen[str], list[str]]]"
"""Starts a module; gives its process, and its lines up to one with the text `until`."""


@contextmanager
def running() -> Generator[StartModule, None, None]:
    """Start modules as processes, which are stopped at the end."""
    started: list[subprocess.Popen[str]] = []

    def start(module: str, *arguments: str, until: str) -> tuple[subprocess.Popen[str], list[str]]:
        words = [sys.executable, "-m", module, *arguments]
        process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process, lines_until(until, process)

    yield start
    for process in started:
        process.terminate()
    for process in started:
        ended(process)


@contextmanager
def robots(folders: pytest.TempPathFactory) -> Generator[Callable[[], Robot], None, None]:
    """Start server processes, which are stopped at the end."""
    with running() as run:

        def start() -> Robot:
            urls = ("tcp://127.0.0.1:0", f"unix://{folders.mktemp('robot')}/socket")
            process, (tcp, unix) = run("tests.cli.robot", *urls, until="unix")
            return Robot(process, tcp.strip(), unix.strip())

        yield start


@pytest.fixture(scope="module")
def start_robot(
    tmp_path_factory: pytest.TempPathFactory,
) -> Generator[Callable[[], Robot], None, None]:
    """Starts a server process of one's own, for tests that stop or kill it."""
    with robots(tmp_path_factory) as start:
        yield start


@pytest.fixture(scope="package")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Generator[Robot, None, None]:
    """A server process that all tests of this folder share: leave it as it was, but for goals that
    have ended.
    """
    with robots(tmp_path_factory) as start:
        yield start()


@pytest.fixture
def tcp(robot: Robot) -> str:
    """The shared server, over TCP."""
    return robot.tcp


@pytest.fixture(params=["tcp", "unix"])
def url(request: pytest.FixtureRequest, robot: Robot) -> str:
    """The shared server, once over each transport."""
    return str(getattr(robot, request.param))


@pytest.fixture
def nobody(unused_tcp_port: int) -> str:
    """A URL where no server listens."""
    return f"tcp://127.0.0.1:{unused_tcp_port}"


@pytest.fixture(autouse=True)
def level_of_the_log() -> Iterator[None]:
    """The levels that commands lower, as they were."""
    before = {name: logging.getLogger(name).level for name in ("", "fibaction.wire")}
    yield
    for name, level in before.items():
        logging.getLogger(name).setLevel(level)


# A module of the user's


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder with the module `robot` in it."""
    (tmp_path / "robot.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def eventually(condition: Callable[[], bool]) -> None:
    """Wait, in a thread, for something that tells nobody."""
    for _ in range(int(PATIENCE / 0.02)):
        if condition():
            return
        Event().wait(0.02)
    raise AssertionError(condition)


# The command


@pytest.fixture(scope="session")
def fibaction() -> Run:
    """Runs the command as a process, to its end. `url` is told it by `FIBACTION_URL`."""

    def run(*arguments: str, input: str | None = None, **settings: Any) -> Finished:
        return ended(start_command(*arguments, **settings), input)

    return run


def detached(run: Run, url: str, *goal: str) -> str:
    """Send a goal, and give its ID."""
    return run("send_goal", *goal, "--detach", url=url).out.strip()


def start_command(
    *arguments: str, url: str | None = None, env: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """The command as a process, with pipes."""
    return subprocess.Popen(
        command(*arguments),
        env=environment(url, env),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
    )


@pytest.fixture
def started() -> Iterator[Start]:
    """Starts the command as a process, for tests that read its lines or send it signals; what is
    left of it at the end of the test is killed.
    """
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: str, **settings: Any) -> subprocess.Popen[str]:
        processes.append(start_command(*arguments, **settings))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        with process:
            process.communicate()


@pytest.fixture(autouse=True)
def signals_of_its_own(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let nothing end this process that is to end one of the command: no handler of a signal, no
    alarm, and no end of the last seconds is left to the next test.
    """
    monkeypatch.setattr(signals, "GRACE", 60.0)
    for module in (serve, serve_mcp):
        monkeypatch.setattr(module, "LAST_SECONDS", 3600.0)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def invoke() -> Invoke:
    """Runs the command in this process. Not from a test that is itself async."""

    def run(
        *arguments: str,
        url: str | None = None,
        input: str | bytes | None = None,
        env: Mapping[str, str | None] | None = None,
    ) -> Result:
        settings = {"FIBACTION_URL": url, "NO_COLOR": None, **(env or {})}
        result = CliRunner().invoke(
            cli, arguments, input=input, env=settings, prog_name="fibaction"
        )
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result

    return run


@pytest.fixture(scope="session")
def here(invoke: Invoke) -> Run:
    """Runs the command in this process, and gives what came of it as if it were a process."""

    def run(*arguments: str, **settings: Any) -> Finished:
        result = invoke(*arguments, **settings)
        return Finished(result.exit_code, result.stdout, result.stderr)

    return run


# The command in a terminal


class Terminal:
    """The command in a terminal of its own: what a person sees there, and the keys."""

    screen_type = pyte.HistoryScreen

    def __init__(
        self,
        *arguments: str,
        url: str | None = None,
        env: Mapping[str, str] | None = None,
        columns: int = 80,
        lines: int = 24,
    ) -> None:
        self._screen = self.screen_type(columns, lines, history=10_000, ratio=1)
        self._stream = pyte.ByteStream(self._screen)
        self.raw = b""
        """All that was written, escape sequences included."""
        self._master, slave = pty.openpty()
        size = struct.pack("HHHH", lines, columns, 0, 0)
        fcntl.ioctl(slave, termios.TIOCSWINSZ, size)
        self.process = subprocess.Popen(
            command(*arguments),
            env=environment(url, {"TERM": "xterm-256color", **(env or {})}),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            # So that Ctrl-C becomes a SIGINT for it.
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(slave)

    @property
    def screen(self) -> list[str]:
        """The lines that are on the screen now, without the blanks at their ends."""
        return [str(line).rstrip() for line in self._screen.display]

    @property
    def text(self) -> str:
        """What is on the screen, and what has scrolled out of it at the top."""
        width = self._screen.columns
        above = [
            "".join(line[column].data for column in range(width)).rstrip()
            for line in self._screen.history.top
        ]
        return "\n".join([*above, *self.screen]).rstrip()

    @property
    def cursor_hidden(self) -> bool:
        """Whether the cursor was left hidden."""
        return bool(self._screen.cursor.hidden)

    def press(self, keys: str) -> None:
        """Type; `\\x03` is Ctrl-C."""
        os.write(self._master, keys.encode())

    def until(self, condition: str | Callable[[list[str]], bool]) -> list[str]:
        """Wait until a pattern is found in `text`, or the screen fulfils a condition; gives the
        screen.
        """
        deadline = time.monotonic() + PATIENCE
        while not self._fulfils(condition):
            left = deadline - time.monotonic()
            if not (left > 0 and self._read(left)):
                raise AssertionError(f"there is no {condition!r} in:\n{self.text}")
        return self.screen

    def ends(self) -> int:
        """Wait until the command has ended; gives its exit code."""
        deadline = time.monotonic() + PATIENCE
        while self._read(max(0.0, deadline - time.monotonic())):
            pass
        return self.process.wait(max(0.1, deadline - time.monotonic()))

    def close(self) -> None:
        """Kill what is left of it."""
        self.process.kill()
        self.process.wait()
        os.close(self._master)

    def _fulfils(self, condition: str | Callable[[list[str]], bool]) -> bool:
        if isinstance(condition, str):
            return re.search(condition, self.text, re.MULTILINE) is not None
        return condition(self.screen)

    def _read(self, seconds: float) -> bool:
        """Take what there is, or wait for it; False if there is no more."""
        if not select.select([self._master], [], [], seconds)[0]:
            return False
        try:
            data = os.read(self._master, 65536)
        except OSError:  # the terminal has no other end any more
            return False
        self.raw += data
        self._stream.feed(data)
        return bool(data)


@pytest.fixture
def terminal() -> Iterator[Open]:
    """Runs the command in a pseudo-terminal."""
    opened: list[Terminal] = []

    def open_one(*arguments: str, **settings: Any) -> Terminal:
        opened.append(Terminal(*arguments, **settings))
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


def interrupt(process: subprocess.Popen[Any]) -> None:
    """Ctrl-C for a process that has no terminal."""
    process.send_signal(signal.SIGINT)
