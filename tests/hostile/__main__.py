"""Attacks on a server, and on a participant of RTPS: what each costs honest clients and the victim.

    make attack          # all, for 20 s each; or: python -m tests.hostile --seconds 60 NAME ...

Victim, honest client and attacker are processes of their own. For each attack it prints the honest
client's latencies in milliseconds; at their 99th percentile the work of the victim meanwhile, in
milliseconds of the processor, which other programs do not change; the longest turn of the victim's
event loop, and the longest garbage collection, which is a part of a turn, in the same; and the peak
of the victim's memory above the idle one, with its bound. It fails if a bound is broken, if a goal
takes more than 100 ms at the 99th percentile, or if SIGTERM does not end the victim in time. With
`--seconds 0` each attack is as short as in `make test`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import anyio

from tests.hostile.arena import Figures, figures_of
from tests.hostile.attacks import ATTACKS
from tests.hostile.rtps import crowd
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS
from tests.hostile.verdict import faults
from tests.trials import add_names, command_line, named

P99 = 0.1
"""Seconds that the honest client's goals take at the 99th percentile, at most."""
HEAD = (
    f"{'attack':46} {'goals':>6} {'p50':>7} {'p99':>7} {'max':>7} {'work':>6} {'turn':>6}"
    f" {'gc':>6} {'MiB':>5} {'bound':>5} {'stop':>5}  ok"
)


def row(name: str, found: Figures, above: int) -> str:
    """Return the figures of an attack as a line of the table."""
    times = " ".join(f"{found.latency(part) * 1000:7.1f}" for part in (0.5, 0.99, 1))
    return (
        f"{name:46} {len(found.latencies):6} {times} {found.work_of(0.99) * 1000:6.1f}"
        f" {found.reading.longest * 1000:6.1f}"
        f" {found.reading.collecting * 1000:6.1f}"
        f" {found.above:5.0f} {above:5} {found.stopped:5.1f} "
    )


async def attack(name: str, seconds: float) -> tuple[str, list[str]]:
    """Make an attack; return its row, and the bounds that were broken."""
    is_trial = seconds > 0
    if name in DATAGRAM_ATTACKS:
        by_datagrams = DATAGRAM_ATTACKS[name]
        found = await crowd.figures_of(name, seconds)
        wrong = crowd.broken_bounds(by_datagrams, found, is_trial=is_trial)
        return row(name, found, by_datagrams.above), wrong
    found = await figures_of(name, seconds)
    wrong = faults(ATTACKS[name], found, is_trial=is_trial)
    if is_trial and found.latency(0.99) > P99:
        wrong.append(f"p99 is {found.latency(0.99) * 1000:.0f} ms")
    return row(name, found, ATTACKS[name].above), wrong


def _leaves(group: BaseExceptionGroup[Exception]) -> Iterator[BaseException]:
    for exc in group.exceptions:
        if isinstance(exc, BaseExceptionGroup):
            yield from _leaves(exc)
        else:
            yield exc


async def run(names: list[str], seconds: float) -> int:
    """Run the attacks; return how many broke a bound."""
    broken = 0
    print(HEAD, flush=True)
    for name in names:
        try:
            line, wrong = await attack(name, seconds)
        except* Exception as group:
            wrong = [f"{type(exc).__name__}: {exc}"[:200] for exc in _leaves(group)]
            print(f"{name:46}  {'; '.join(wrong)}", flush=True)
        else:
            print(line, "; ".join(wrong) or "ok", flush=True)
        broken += bool(wrong)
    print(f"{broken} of {len(names)} attacks broke a bound")
    return broken


def main(*words: str) -> int:
    """Run the attacks that the arguments name, or the command line."""
    parser = command_line("tests.hostile", __doc__)
    add_names(parser, "attacks")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="for each attack; %(default)g if not given"
    )
    arguments = parser.parse_args(words or None)
    if not 0 <= arguments.seconds < math.inf:
        parser.error("--seconds is 0 or more")
    short = [name for name, attack in ATTACKS.items() if arguments.seconds or not attack.is_long]
    names = named(parser, arguments.names, [*short, *DATAGRAM_ATTACKS])
    return 1 if anyio.run(lambda: run(names, arguments.seconds)) else 0


if __name__ == "__main__":
    sys.exit(main())
