"""Two makes at the same time, for `make test`.

    python -m tests.tools.beside TARGETS OTHERS     # beside "unit" "types programs"

The output of the first is shown as it comes, and that of the other, whole, after it. At the first
failure the other make is stopped, and the output of the one that failed is the last. It needs no
more than Python, so that it runs before anything is installed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from typing import IO

GRACE = 20.0
"""Seconds for pytest to end its processes after a Ctrl-C, before they are killed."""


def start(targets: str, output: IO[bytes] | None = None) -> subprocess.Popen[bytes]:
    """Start a make of these targets, which can be stopped with all that it starts."""
    return subprocess.Popen(
        [os.environ.get("MAKE", "make"), "--no-print-directory", *targets.split()],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output and subprocess.STDOUT,
        start_new_session=True,
    )


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a make, if it has not ended, and all that it started."""
    for number in (signal.SIGINT, signal.SIGKILL):
        if process.poll() is None:
            os.killpg(process.pid, number)
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                continue


def run(shown: str, kept: str) -> int:
    """Run both, and return the exit status."""
    with tempfile.TemporaryFile() as output:
        first, second = both = start(shown), start(kept, output)
        try:
            while None in (ends := [each.poll() for each in both]) and not any(ends):
                time.sleep(0.1)  # noqa: TID251  # nothing waits for the first of two processes
            has_failed = bool(first.returncode)
        finally:
            for each in both:
                stop(each)
        if not has_failed:
            output.seek(0)
            sys.stdout.buffer.write(output.read())
            sys.stdout.flush()
    return int(has_failed or bool(second.returncode))


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:3]))
