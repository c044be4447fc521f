"""Walks through the commands of a page, in real shells.

A block of shell commands is marked with the terminal that it is for. Commands follow a `$`; the
lines below a command are what it prints, and `...` stands for any lines. Files that the page has
its reader write are marked, too. All terminals of a page share one folder.

This module has the marks and the shells; its callers have the pages.
"""

from __future__ import annotations

import os
import queue
import re
import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from tests.support.pages import Block, blocks_of, programs_of
from tests.support.ports import free_port

PATIENCE = 60.0
"""The timeout for an expected line, in seconds: many times as long as any command takes."""
ENDING = 10.0
"""Seconds that programs have for their end after a signal."""
ROOT = Path(__file__).resolve().parents[2]
CLONE = "~/fibaction"
"""The folder of the repository in pages."""
DEFAULT_PORT, BROKER_PORT, WEB_PORT = "7400", "4222", "8080"
"""The ports in pages, which other programs of this machine may use."""

_TERMINAL = re.compile(
    r"<!-- terminal: (?P<name>\w+)(?P<on>, runs on)?(?P<ros>, where ROS 2 is)? -->\n\Z"
)
_FILE = re.compile(r"<!-- file: (?P<path>[\w./]+)(?P<ros>, where ROS 2 is)? -->\n\Z")
_END = "--- the end of a command ---"
# What is another one in each run, in this order: IDs, stamps, processes, clients, ages of goals and
# how much feedback they had by then, also in JSON. Columns are as wide as that.
_CHANGING = {
    r"\b[0-9a-f]{32}\b": "ID",
    r"\b\d{19}\b": "STAMP",
    r"process \[\d+\]": "process [PID]",
    r"127\.0\.0\.1:\d{5}\b": "127.0.0.1:PORT",
    r"\b\d+\.\d s +\d+ ": "AGE COUNT ",
    r"\b\d+\.\d s\b": "AGE",
    r'"(feedback_count|waited|ran)":[\d.e-]+': "MEASURED",
    r" +": " ",
}

# With Python 3.11, asyncio may print this when it closes a process that has just ended. The race is
# https://github.com/python/cpython/issues/86276; later versions wait for processes in another way.
_RACE_OF_ASYNCIO = re.compile(r"Unknown child process pid \d+, will report returncode 255\n")


class Step(NamedTuple):
    """A command, or Ctrl-C, and the output after it."""

    command: str
    expected: list[str]


def terminal_of(block: Block) -> re.Match[str] | None:
    """Return the mark that names the terminal of a block."""
    return _TERMINAL.search(block.before)


def file_of(block: Block) -> re.Match[str] | None:
    """Return the mark that names the file of a block."""
    return _FILE.search(block.before)


def steps_of(code: str) -> list[Step]:
    """Return the commands of a block, each with its output.

    Raises:
        ValueError: The block begins with output.
    """
    steps: list[Step] = []
    for line in code.splitlines():
        if line == "^C" or line.startswith("$ "):
            steps.append(Step(line.removeprefix("$ "), []))
        elif steps:
            steps[-1].expected.append(line)
        else:
            raise ValueError(f"no command prints {line!r}")
    return steps


def walk(page: str, folder: Path, *, ros: bool = False) -> list[str]:
    """Run the commands of a page in a folder, and return the differences to the page.

    With `ros`, that is the commands that need ROS 2; else it is all others.
    """
    return [line for part in programs_of(page) for line in _walk(part, folder, ros)]


def _walk(page: str, folder: Path, ros: bool) -> list[str]:
    """Run the commands of one program of a page."""
    ports = {one: str(free_port()) for one in (DEFAULT_PORT, BROKER_PORT, WEB_PORT)}
    port = ports[DEFAULT_PORT]
    # All at once: a free port may contain the digits of another one.
    page = re.sub("|".join(ports), lambda found: ports[found[0]], page)
    page = page.replace(CLONE, str(ROOT))
    terminals: dict[str, Terminal] = {}
    wrong: list[str] = []
    try:
        for block in blocks_of(page):
            if (marked := file_of(block)) is not None and (ros or not marked["ros"]):
                path = folder / marked["path"]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.code, encoding="utf-8")
                if path.name == "pyproject.toml":
                    install(path)
            if (marked := terminal_of(block)) is None or bool(marked["ros"]) is not ros:
                continue
            terminal = terminals.get(marked["name"])
            if terminal is None:
                terminals[marked["name"]] = terminal = Terminal(folder, port)
            steps = steps_of(block.code)
            for number, step in enumerate(steps, start=1):
                runs_on = bool(marked["on"]) and number == len(steps)
                wrong += terminal.does(step, runs_on, f"line {block.line}")
    finally:
        for terminal in terminals.values():
            terminal.close()
    return wrong


def install(project: Path) -> None:
    """Write the files beside a `pyproject.toml` that `pip install -e .` would install."""
    described = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    name, version = described["name"].replace("-", "_"), described["version"]
    folder = project.parent / f"{name}-{version}.dist-info"
    folder.mkdir()
    metadata = f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n"
    (folder / "METADATA").write_text(metadata, encoding="utf-8")
    lines = [
        f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in entries.items())
        for group, entries in described["entry-points"].items()
    ]
    (folder / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


class Terminal:
    """A shell in a folder."""

    def __init__(self, folder: Path, port: str) -> None:
        self._shell = subprocess.Popen(
            ["bash", "--noprofile", "--norc"],
            cwd=folder,
            env=_environment(os.environ, folder, port),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reading = threading.Thread(target=self._read)
        self._reading.start()
        # Ctrl-C is for what runs in the shell, and not for the shell.
        self._type("trap : INT")

    def _type(self, command: str) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.write(f"{command}\n")
        self._shell.stdin.flush()

    def _read(self) -> None:
        assert self._shell.stdout is not None
        for line in self._shell.stdout:
            if not _RACE_OF_ASYNCIO.fullmatch(line):
                self._lines.put(line.rstrip("\n"))

    def does(self, step: Step, runs_on: bool, where: str) -> list[str]:
        """Run a step; return the difference to the expected output, if any."""
        if step.command == "^C":
            self._signal(signal.SIGINT)
        else:
            self._type(f"{{ {step.command}\n}} </dev/null\nprintf '\\n%s\\n' '{_END}'")
        printed = list(self._first(len(step.expected)) if runs_on else self._until_end())
        if _is_like(printed, step.expected):
            return []
        text, said = "\n".join(printed), "\n".join(step.expected)
        return [f"{where}: `{step.command}` prints\n{text}\nand the page says\n{said}\n"]

    def _first(self, count: int) -> Iterator[str]:
        """Return so many lines of output."""
        for _ in range(count):
            yield self._next()

    def _until_end(self) -> list[str]:
        """Return all lines until the command has ended."""
        lines = list(iter(self._next, _END))
        # In front of the end stands a line break: it ends a last line that had none.
        return lines if lines[-1] else lines[:-1]

    def _next(self) -> str:
        try:
            return self._lines.get(timeout=PATIENCE)
        except queue.Empty:
            raise TimeoutError("nothing more is printed") from None

    def close(self) -> None:
        """End the shell, and all programs in it."""
        self._signal(signal.SIGTERM)
        self._reading.join(ENDING)  # there is more to read until the last of them has ended
        self._signal(signal.SIGKILL)
        with self._shell:
            self._shell.wait()
            self._reading.join()

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):  # all have ended already
            os.killpg(self._shell.pid, number)


def _environment(outside: Mapping[str, str], folder: Path, port: str) -> dict[str, str]:
    """Return the environment of a shell, with the programs that are beside this Python."""
    inside = {name: value for name, value in outside.items() if not name.startswith("FIBACTION_")}
    inside["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), outside["PATH"]))
    inside["FIBACTION_URL"] = f"tcp://127.0.0.1:{port}"  # the usual one, but for the port
    inside["PYTHONPATH"] = str(folder)  # where `install` puts things
    inside["PYTHONUNBUFFERED"] = "1"
    inside["PYTHONDONTWRITEBYTECODE"] = "1"
    return inside


def _is_like(printed: list[str], expected: list[str]) -> bool:
    pattern = "".join(
        "(?:.*\n)*" if line == "..." else re.escape(_same(line)) + "\n" for line in expected
    )
    return re.fullmatch(pattern, "".join(_same(line) + "\n" for line in printed)) is not None


def _same(line: str) -> str:
    for changing, name in _CHANGING.items():
        line = re.sub(changing, name, line)
    return line.rstrip()
