"""Measures the memory that a large recording needs: `python -m tests.tools.large_recording [--mb
1000]`.

It makes a recording of that size, with one goal after another, and prints the seconds and the peak
of the resident memory of processes that summarise it, export it, and replay its last goal.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import msgspec

from fibaction.observe.recordings.recording_file import Record
from tests.support.fibonacci import FIBONACCI

FEEDBACK = 10_000
"""Feedback messages of a goal."""

REPLAY = """
import sys, anyio
from fibaction import connect, serve
from fibaction.observe.recordings.replay import replayed
from tests.support.fibonacci import FIBONACCI, Goal

async def main():
    async with serve(replayed(sys.argv[1], speed=1e9), "inproc://replay"):
        async with connect("inproc://replay", FIBONACCI) as client:
            print(await client.call(Goal(int(sys.argv[2]))))

anyio.run(main)
"""


def write_recording(path: Path, size: int) -> int:
    """Write a recording of at least so many bytes; return the number of its goals."""
    encode, goals, time = msgspec.json.encode, 0, 0
    with open(path, "wb") as file:
        file.write(encode(Record(0, "server", "fibonacci", info=FIBONACCI.info)) + b"\n")
        while file.tell() < size:
            goals += 1
            goal_id = f"{goals:032x}"
            order = {"order": goals}
            lines = [Record(time, "accepted", "fibonacci", goal_id, "EXECUTING", data=order)]
            for number in range(1, FEEDBACK + 1):
                feedback = {"partial_sequence": [number]}
                lines.append(
                    Record(
                        time + number,
                        "feedback",
                        "fibonacci",
                        goal_id,
                        number=number,
                        data=feedback,
                    )
                )
            time += FEEDBACK + 1
            result = {"sequence": [goals]}
            lines.append(Record(time, "end", "fibonacci", goal_id, "SUCCEEDED", data=result))
            file.write(b"".join(encode(line) + b"\n" for line in lines))
    return goals


def measure(what: str, *command: str) -> None:
    """Run a command, and print its time and the peak of its memory."""
    begin = perf_counter()
    with subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        last = process.stdout.read().decode().splitlines()[-1]
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    seconds = perf_counter() - begin
    print(f"{what}: {seconds:.0f} s, {usage.ru_maxrss / 1024:.0f} MB; {last}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.large_recording", description=__doc__
    )
    parser.add_argument("--mb", type=int, default=1000, help="size of the recording")
    megabytes = parser.parse_args().mb
    with TemporaryDirectory() as folder:
        path = Path(folder) / "large.jsonl"
        goals = write_recording(path, megabytes * 10**6)
        measure("show", "-m", "fibaction", "show", str(path))
        measure("export", "-m", "fibaction", "export", str(path), f"{path}.mcap")
        measure("replay", "-c", REPLAY, str(path), str(goals))


if __name__ == "__main__":
    main()
