"""The bounds that hold in every attack."""

from __future__ import annotations

import re

from tests.hostile.arena import SHUTDOWN, Figures
from tests.hostile.attack import Attack
from tests.hostile.rtps.datagram_attacks import DatagramAttack

LONGEST_TURN = 0.1
"""Seconds of the processor that one turn of the server's event loop may take, in a trial."""
DEAREST_TURN = 1000
"""The honest calls without the attack whose work one turn may take, in `make test`: other programs
make both slower.
"""
LONGEST_LINE = 1000
"""Characters of a line of the log."""


def faults(attack: Attack | DatagramAttack, found: Figures, *, is_trial: bool = False) -> list[str]:
    """Return the bounds that were broken. Those of time are seconds in a trial, which has the
    machine for itself, and else ratios to the same calls without the attack.
    """
    wrong: list[str] = []
    if found.reading.longest > (LONGEST_TURN if is_trial else DEAREST_TURN * found.quiet):
        wrong.append(
            f"a turn took {found.reading.longest * 1000:.0f} ms,"
            f" and a call without the attack {found.quiet * 1000:.2f} ms"
        )
    if found.code != 0 or (is_trial and found.stopped > SHUTDOWN):
        wrong.append(f"SIGTERM took {found.stopped:.1f} s, exit code {found.code}")
    if found.above > attack.above:
        wrong.append(f"{found.above:.0f} MiB above the idle server, not {attack.above}")
    wrong += found.log.splitlines()[-1:] if found.code else []
    if forged := [line for line in lines_of(found.log) if not is_honest(line)]:
        wrong.append(f"{len(forged)} lines of the log are forged or too long: {forged[0][:200]!r}")
    if "the connection failed" in found.log:
        wrong.append("the log tells of a bug")
    return wrong


def lines_of(log: str) -> list[str]:
    """Return the lines that a reader of the log may see."""
    return re.split("[\n\r\u2028]", log)


def is_honest(line: str) -> bool:
    """Return whether a line of the log is as the server meant it."""
    return (
        len(line) <= LONGEST_LINE
        and (line.isprintable() or line == "")
        and not re.match(r"(2026-01-01 00:00:00,000 fibaction\.wire: )?FORGED", line)
    )
