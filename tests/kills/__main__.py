"""Kill a server again and again while clients use it, and check that it keeps what it told.

    python -m tests.kills --seconds 120 --clients 20 --recovery rerun

The server keeps its goals in a file. It is ended by SIGKILL at random moments, some of them during
its start, and started again at the same address. It prints what has happened as JSON, and fails if
a promise is broken: an acceptance, a cancel, a checkpoint or an end that is forgotten, two ends of
one goal, an attempt too many, or a call of a client that does not return.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

import anyio
import msgspec

from tests.kills.harness import run
from tests.trials import command_line, count, seconds


def main(*words: str) -> int:
    """Run as the arguments say, or those of the command line, and return the exit code."""
    parser = command_line("tests.kills", __doc__)
    parser.add_argument("--seconds", type=seconds, default=120.0, help="default: %(default)g")
    parser.add_argument("--clients", type=count, default=20, help="default: %(default)d")
    parser.add_argument("--recovery", choices=("abort", "rerun"), default="abort")
    parser.add_argument("--seed", type=int, default=random.randrange(2**32))
    arguments = parser.parse_args(words or None)
    with tempfile.TemporaryDirectory() as folder:
        report = anyio.run(
            run,
            Path(folder),
            arguments.seconds,
            arguments.clients,
            arguments.recovery,
            arguments.seed,
        )
    print(msgspec.json.format(msgspec.json.encode(report)).decode())
    return 1 if report.faults else 0


if __name__ == "__main__":
    sys.exit(main())
