"""The verdict on an attack: each bound, in a trial and beside other programs."""

from __future__ import annotations

import pytest

from tests.hostile.arena import Figures
from tests.hostile.attacks import ATTACKS
from tests.hostile.meter import Reading
from tests.hostile.rtps.crowd import broken_bounds
from tests.hostile.rtps.datagram_attacks import DATAGRAM_ATTACKS
from tests.hostile.verdict import faults

READING = Reading(0.01, 1.0, 40 * 2**20, 40 * 2**20, 0.0)
FIGURES = Figures(READING, 1.0, [0.001, 0.002, 0.003], [0.001], 0.0002, 0.1, 0, "", 1000, 2000)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"reading": READING._replace(longest=0.2)}, "a turn took 200 ms"),
        ({"above": 5000.0}, "5000 MiB above the idle server"),
        ({"stopped": 9.0}, "SIGTERM took 9.0 s"),
        ({"code": -9}, "exit code -9"),
        ({"work": [0.4]}, "400 ms of work"),
        ({"sent": 10**9}, "it sent 1,000,000,000 bytes for 1,000"),
        ({"log": "a line\nFORGED\n"}, "1 lines of the log are forged"),
        ({"log": "a line\x1b[2J"}, "1 lines of the log are forged"),
        ({"log": "x" * 2000}, "1 lines of the log are forged or too long"),
    ],
)
def test_each_broken_bound_is_told(changed: dict[str, object], said: str) -> None:
    attack = next(iter(DATAGRAM_ATTACKS.values()))

    assert broken_bounds(attack, FIGURES, is_trial=True) == []
    broken = FIGURES._replace(**changed)  # type: ignore[arg-type]  # of each field
    assert said in " ".join(broken_bounds(attack, broken, is_trial=True))


@pytest.mark.parametrize(
    "changed",
    [
        {"reading": READING._replace(longest=0.21), "quiet": 0.0002},
        {"reading": READING._replace(longest=0.051), "quiet": 0.00005},
        {"code": None},
    ],
)
def test_beside_other_programs_a_bound_of_time_is_a_ratio(changed: dict[str, object]) -> None:
    attack = next(iter(ATTACKS.values()))

    busy = FIGURES._replace(reading=READING._replace(longest=0.3), quiet=0.001, stopped=9.0)
    assert faults(attack, busy) == []
    assert faults(attack, FIGURES._replace(**changed))  # type: ignore[arg-type]  # of each field
