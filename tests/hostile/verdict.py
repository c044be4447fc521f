"""The bounds that hold in every attack."""

from __future__ import annotations

import re

from tests.hostile.arena import SHUTDOWN, Figures
from tests.hostile.attack import Attack

LONGEST_TURN = 0.1
"""Seconds of the processor that one turn of the server's event loop may take."""
LONGEST_LINE = 1000
"""Characters of a line of the log."""


def faults(attack: Attack, found: Figures) -> list[str]:
    """Return the bounds that were broken."""
    wrong: list[str] = []
    if found.reading.longest > LONGEST_TURN:
        wrong.append(f"a turn took {found.reading.longest * 1000:.0f} ms")
    if found.above > attack.above:
        wrong.append(f"{found.above:.0f} MiB above the idle server, not {attack.above}")
    if found.code != 0 or found.stopped > SHUTDOWN:
        wrong.append(f"SIGTERM took {found.stopped:.1f} s, exit code {found.code}")
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
