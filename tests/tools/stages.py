"""Targets of make in lanes that run at the same time, each lane one target after the other.

    python -m tests.tools.stages LANE [LANE...]

A lane is one argument, for example "lint, types" or "test-ros ROS=kilted, test-ros ROS=jazzy".
The output of the first lane is shown as it comes, that of the others target by target, whole, when
the first lane is over. At the first failure all other lanes are stopped, and the output of the
target that failed is the last. It needs no more than Python, so that it runs before anything is
installed.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from queue import SimpleQueue
from typing import IO, NamedTuple

GRACE = 20.0
"""Seconds for pytest to end its processes after a Ctrl-C, before they are killed."""


class Ended(NamedTuple):
    """The end of one target of a lane, or of the lane."""

    lane: int
    target: str
    status: int
    seconds: float
    output: bytes
    """What was written and not shown yet."""


class Lane(threading.Thread):
    """Targets of make that run one after the other."""

    def __init__(self, number: int, targets: list[str], ended: SimpleQueue[Ended]) -> None:
        super().__init__(daemon=True)
        self._number = number
        self._targets = targets
        self._ended = ended
        self._is_stopped = False
        self._process: subprocess.Popen[bytes] | None = None

    def run(self) -> None:
        for target in self._targets:
            begun = time.monotonic()
            if self._is_stopped:
                return
            self._process = subprocess.Popen(
                [os.environ.get("MAKE", "make"), "--no-print-directory", *shlex.split(target)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # to be stopped with all that it starts
            )
            assert self._process.stdout is not None
            output = self._read(self._process.stdout)
            status = self._process.wait()
            self._ended.put(Ended(self._number, target, status, time.monotonic() - begun, output))
            if status:
                return

    def stop(self) -> None:
        """Stop what runs, and begin nothing more."""
        self._is_stopped = True
        for number in (signal.SIGINT, signal.SIGKILL):
            if self._process is None or self._process.poll() is not None:
                return
            os.killpg(self._process.pid, number)
            self.join(GRACE)

    def _read(self, pipe: IO[bytes]) -> bytes:
        """Return all that is written, or show it at once if this is the first lane."""
        if self._number:
            return pipe.read()
        while part := pipe.read1(65536):  # type: ignore[attr-defined]  # the pipe is buffered
            show(part)
        return b""


def show(output: bytes) -> None:
    """Write this to the standard output, at once."""
    sys.stdout.buffer.write(output)
    sys.stdout.buffer.flush()


def say(line: str) -> None:
    """Write a line of this program."""
    show(f"{line}\n".encode())


def run(lanes: list[list[str]]) -> int:
    """Run the lanes, and return the exit status."""
    ended: SimpleQueue[Ended] = SimpleQueue()
    threads = [Lane(number, targets, ended) for number, targets in enumerate(lanes)]
    for thread in threads:
        thread.start()
    kept: list[Ended] = []
    times: list[str] = []
    try:
        while len(times) < sum(map(len, lanes)):
            end = ended.get()
            times.append(f"{end.target} {end.seconds:.0f} s")
            if end.status:
                for thread in threads:
                    thread.stop()
                _show(kept)
                _show([end])
                say(f"make {end.target} failed after {end.seconds:.0f} s")
                return 1
            kept.append(end)
            if threads[0].is_alive() and end.lane:
                continue
            _show(kept)
            kept.clear()
    except KeyboardInterrupt:
        for thread in threads:
            thread.stop()
        return 130
    _show(kept)
    say(f"passed: {', '.join(times)}")
    return 0


def _show(kept: list[Ended]) -> None:
    for end in kept:
        if end.lane:
            say(f"---- make {end.target} ({end.seconds:.0f} s)")
            show(end.output)


def main() -> int:
    """Run the command, and return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.stages",
        description="Run targets of make in lanes, at the same time.",
    )
    parser.add_argument("lanes", nargs="+", metavar="LANE", help='for example "lint, types"')
    chosen = parser.parse_args()
    return run([[each.strip() for each in lane.split(",")] for lane in chosen.lanes])


if __name__ == "__main__":
    sys.exit(main())
