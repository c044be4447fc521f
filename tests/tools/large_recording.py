"""Measures the memory that a large recording needs: `python -m tests.tools.large_recording [--mb
1000]`.

It makes a recording of that size, with one goal after another, and prints the seconds and the peak
of the resident memory of processes that summarise it, export it, and replay its last goal.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import msgspec

from fibaction.observe.recordings.recording_file import Record
from tests.support.fibonacci import FIBONACCI
from tests.support.processes import used_by

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


def lines_of(goal: int, begin: int) -> Iterator[Record]:
    """Yield the lines of a goal, from its acceptance to its end."""
    goal_id = f"{goal:032x}"
    yield Record(begin, "accepted", "fibonacci", goal_id, "EXECUTING", data={"order": goal})
    for number in range(1, FEEDBACK + 1):
        data = {"partial_sequence": [number]}
        yield Record(begin + number, "feedback", "fibonacci", goal_id, number=number, data=data)
    end, result = begin + FEEDBACK + 1, {"sequence": [goal]}
    yield Record(end, "end", "fibonacci", goal_id, "SUCCEEDED", data=result)


def write_recording(path: Path, size: int) -> int:
    """Write a recording of at least so many bytes; return the number of its goals."""
    encode, goals = msgspec.json.encode, 0
    with open(path, "wb") as file:
        file.write(encode(Record(0, "server", "fibonacci", info=FIBONACCI.info)) + b"\n")
        while file.tell() < size:
            lines = lines_of(goals + 1, goals * (FEEDBACK + 1))
            file.write(b"".join(encode(line) + b"\n" for line in lines))
            goals += 1
    return goals


def measure(what: str, *command: str) -> None:
    """Run a command, and print its time and the peak of its memory."""
    begin = perf_counter()
    used = used_by([sys.executable, *command])
    seconds = perf_counter() - begin
    last = used.out.splitlines()[-1]
    print(f"{what}: {seconds:.0f} s, {used.memory / 2**20:.0f} MB; {last}", flush=True)


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
