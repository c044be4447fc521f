"""Programs that tests run as processes of their own: what they print, and their ends."""

from __future__ import annotations

import json
import re
import subprocess
from typing import Any, NamedTuple

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
