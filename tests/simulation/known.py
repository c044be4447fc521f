"""What runs are known to find, and what is not mended yet: each with its cause.

A run that begins with one of these is counted, and is no failure. An entry goes with its cause.
"""

from __future__ import annotations

import re

import msgspec

from tests.simulation.invariants import Violation


class Known(msgspec.Struct, frozen=True):
    """A violation that is expected to be found now and then."""

    invariant: str
    text: str
    """A regular expression that is found in its text."""
    cause: str


KNOWN: tuple[Known, ...] = ()


def is_known(violation: Violation) -> bool:
    """Whether that is nothing new."""
    return any(
        known.invariant == violation.invariant and re.search(known.text, violation.text)
        for known in KNOWN
    )
