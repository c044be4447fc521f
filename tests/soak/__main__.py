"""A soak: fifty connections with goals of all kinds, for some minutes, between two processes.

    make soak            # ten minutes alone, and ten under load, for docs/shown_to_hold.md
    python -m tests.soak --seconds 60 --over ws --load 4

It records, 120 times, how much memory the server and the clients use, and how many tasks, open
files and threads they have. At the end it fails if memory has grown after the first tenth of the
time, or if anything else was left.
"""

from __future__ import annotations

import sys

import anyio

from tests.soak.ends import CONNECTIONS
from tests.soak.trial import Soak, faults, run
from tests.tools import figures
from tests.trials import command_line, seconds


def main(*words: str) -> int:
    parser = command_line("tests.soak", __doc__)
    parser.add_argument("--seconds", type=seconds, default=600.0, help="default: %(default)g")
    parser.add_argument(
        "--over", choices=list(CONNECTIONS), default="tcp", help="default: %(default)s"
    )
    parser.add_argument(
        "--load", type=int, choices=range(100), default=0, help="busy processes", metavar="NUMBER"
    )
    parser.add_argument(
        "--keep", action="store_true", help="write the report, its picture and the page of the docs"
    )
    arguments = parser.parse_args(words or None)
    report = anyio.run(run, Soak(arguments.seconds, arguments.over, arguments.load))
    found = faults(report)
    if arguments.keep and not found:
        figures.keep(report)
    print(*(found or [f"{report['goals']:,} goals; nothing has grown"]), sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
