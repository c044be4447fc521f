"""Programs that tests run as processes of their own: what they print, and their ends."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]

PATIENCE = 30.0
"""Seconds for a whole process: many times what the slowest takes on a busy machine."""


class Finished(NamedTuple):
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """The lines of the output."""
        return self.out.splitlines()

    @property
    def json(self) -> list[Any]:
        """The output as JSON, one value a line."""
        return [json.loads(line) for line in self.lines]


def ended(
    process: subprocess.Popen[str], input: str | None = None, *, patience: float = PATIENCE
) -> Finished:
    """Wait for the end of a process, and kill it after a timeout."""
    with process:
        try:
            out, err = process.communicate(input, timeout=patience)
        finally:
            process.kill()
    return Finished(process.returncode, out, err)


def lines_until(pattern: str, process: subprocess.Popen[str], *, errors: bool = False) -> list[str]:
    """Return the output of a process, up to the first line in which the pattern is found; with
    `errors`, its error output.
    """
    stream = process.stderr if errors else process.stdout
    assert stream is not None
    lines: list[str] = []
    while not (lines and re.search(pattern, lines[-1])):
        line = stream.readline()
        assert line, f"it ended after {lines}"
        lines.append(line)
    return lines


class Usage(NamedTuple):
    """The output of a command, and what it used, with all of its threads."""

    out: str
    seconds: float
    """Seconds of the processor."""
    memory: int
    """The most bytes that were resident."""


def used_by(command: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> Usage:
    """Run a command to its end at the root of the repository, and return what it used.

    Raises:
        RuntimeError: It failed.
    """
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        out = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))} failed")
    return Usage(out, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)
