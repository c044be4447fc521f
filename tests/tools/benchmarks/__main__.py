"""`python -m tests.tools.benchmarks all`: measure everything, as `make bench` does it.

`dds` and `topics` measure goals and messages over DDS, with the Python of ROS 2, and print JSON.
`page` makes the pictures and the tables of the docs again, of what was measured last.

Machines are shared and noisy, so every figure stands beside another that was measured in turn with
it, in the same run: read the ratios.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
from importlib.metadata import version

import anyio

from tests.tools.benchmarks import dds, suite, topics

ON_ROS = {"dds": dds.measure, "topics": topics.measure}


def scale(text: str) -> float:
    """Return a number above 0, as otherwise nothing would be measured."""
    number = float(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.tools.benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("subject", choices=["all", "page", *ON_ROS])
    parser.add_argument(
        "--scale", type=scale, default=1.0, help="how much of each to do: less is quicker"
    )
    arguments = parser.parse_args()
    if arguments.subject == "page":
        suite.write()
    elif arguments.subject == "all":
        anyio.run(suite.run, arguments.scale)
    else:
        report = {
            "subject": arguments.subject,
            "python": platform.python_version(),
            "machine": platform.machine(),
            "versions": {name: version(name) for name in ("anyio", "msgspec")},
            **anyio.run(ON_ROS[arguments.subject], arguments.scale),
        }
        print(json.dumps(report, indent=2))


main()
