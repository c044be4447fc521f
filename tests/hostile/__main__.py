"""Attacks on a server, one after another: what each costs an honest client, and the server.

    make attack          # all, for 20 s each; or: python -m tests.hostile --seconds 60 NAME ...

Server, honest client and attacker are processes of their own. For each attack it prints the honest
client's latencies in milliseconds; at their 99th percentile the work of the server meanwhile, in
milliseconds of the processor, which other programs do not change; the longest turn of the server's
event loop, and the longest garbage collection, which is a part of a turn, in the same; and the peak
of the server's memory above the idle one, with its bound. It fails if a bound is broken, if the
latency at the 99th percentile is over 100 ms, or if SIGTERM does not end the server in time. With
`--seconds 0` each attack is as short as in `make test`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator

import anyio

from tests.hostile.arena import Figures, figures_of
from tests.hostile.attacks import ATTACKS
from tests.hostile.verdict import faults

P99 = 0.1
"""Seconds that the honest client's goals take at the 99th percentile, at most."""
HEAD = (
    f"{'attack':46} {'goals':>6} {'p50':>7} {'p99':>7} {'max':>7} {'work':>6} {'turn':>6}"
    f" {'gc':>6} {'MiB':>5} {'bound':>5} {'stop':>5}  ok"
)


def row(name: str, found: Figures) -> str:
    """Return the figures of an attack as a line of the table."""
    times = " ".join(f"{found.latency(part) * 1000:7.1f}" for part in (0.5, 0.99, 1))
    return (
        f"{name:46} {len(found.latencies):6} {times} {found.work_of(0.99) * 1000:6.1f}"
        f" {found.reading.longest * 1000:6.1f}"
        f" {found.reading.collecting * 1000:6.1f}"
        f" {found.above:5.0f} {ATTACKS[name].above:5} {found.stopped:5.1f} "
    )


def _leaves(group: BaseExceptionGroup[Exception]) -> Iterator[BaseException]:
    for exc in group.exceptions:
        if isinstance(exc, BaseExceptionGroup):
            yield from _leaves(exc)
        else:
            yield exc


async def run(names: list[str], seconds: float, *, looks: bool) -> int:
    """Run the attacks; return how many broke a bound."""
    broken = 0
    print(HEAD, flush=True)
    for name in names:
        try:
            found = await figures_of(name, seconds, looks=looks)
        except* Exception as group:
            wrong = [f"{type(exc).__name__}: {exc}"[:200] for exc in _leaves(group)]
            print(f"{name:46}  {'; '.join(wrong)}", flush=True)
        else:
            wrong = faults(ATTACKS[name], found, is_trial=seconds > 0)
            if seconds and found.latency(0.99) > P99:
                wrong.append(f"p99 is {found.latency(0.99) * 1000:.0f} ms")
            print(row(name, found), "; ".join(wrong) or "ok", flush=True)
            if wrong and looks:
                print(f"    {found.reading.slow} slow turns: {found.reading.stack}", flush=True)
        broken += bool(wrong)
    print(f"{broken} of {len(names)} attacks broke a bound")
    return broken


def main(*words: str) -> int:
    """Run the attacks that the arguments name, or the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.hostile",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", help="parts of the names of attacks; all if not given")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="for each attack; %(default)g if not given"
    )
    parser.add_argument(
        "--looks", action="store_true", help="print in which functions the longest turn was"
    )
    arguments = parser.parse_args(words or None)
    if not 0 <= arguments.seconds < math.inf:
        parser.error("--seconds is 0 or more")
    names = [
        name
        for name, attack in ATTACKS.items()
        if any(part in name for part in arguments.names or [""])
        and (arguments.seconds or not attack.is_long)
    ]
    if not names:
        parser.error(f"no attack has such a name; the attacks are {', '.join(ATTACKS)}")
    return 1 if anyio.run(lambda: run(names, arguments.seconds, looks=arguments.looks)) else 0


if __name__ == "__main__":
    sys.exit(main())
