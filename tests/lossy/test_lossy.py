"""Some goals through a bad network, and what the program makes of what it finds.

`tests/transports/cyclone/test_loss.py` has those to and from Cyclone DDS.
"""

from __future__ import annotations

import pytest

from tests.lossy import __main__ as program
from tests.lossy.pairs import ORDER, TERMS, Findings

pytestmark = pytest.mark.timeout(120)


@pytest.mark.parametrize(("loss", "goals"), [(5, 40), (20, 15)])
def test_goals_of_ours_through_a_bad_network_are_right(
    loss: int, goals: int, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("ours to ours", "--goals", str(goals), "--loss", str(loss))
    assert program.main(*words) == 0
    (head, line) = capsys.readouterr().out.splitlines()
    assert head == program.HEAD
    assert line.split()[:6] == ["ours", "to", "ours", str(loss), "%", str(goals)]
    assert line.endswith(" ok")


@pytest.mark.parametrize("fault", ["lost", "twice", "disordered", "incomplete"])
def test_the_program_fails_for_a_goal_that_is_not_right(
    fault: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = Findings()
    setattr(findings, fault, 1)

    async def found(*_: object) -> Findings:
        return findings

    monkeypatch.setattr(program, "try_pair", found)
    assert program.main("ours to ours", "--loss", "5") == 1
    assert capsys.readouterr().out.endswith(" WRONG\n")


def test_only_another_server_may_leave_the_feedback_of_one_goal_incomplete() -> None:
    assert program.is_right("ours to cyclone", Findings(incomplete=1))
    assert not program.is_right("ours to cyclone", Findings(incomplete=2))
    assert not program.is_right("ours to ours", Findings(incomplete=1))
    assert not program.is_right("ours to cyclone", Findings(disordered=1))


def test_feedback_that_is_repeated_swapped_or_missing_is_counted() -> None:
    found = Findings()
    found.note(TERMS)
    assert (found.disordered, found.incomplete) == (0, 0)
    found.note([*TERMS, TERMS[-1]])
    found.note([TERMS[1], TERMS[0], *TERMS[2:]])
    assert (found.disordered, found.incomplete) == (2, 0)
    found.note(TERMS[1:])
    assert (found.disordered, found.incomplete) == (2, 1)
    assert len(TERMS) == ORDER - 1


def test_the_share_of_the_times_is_that_of_the_slowest() -> None:
    assert Findings().at(0.95) == 0
    found = Findings(seconds=[0.3, 0.1, 0.2])
    assert [found.at(share) for share in (0, 0.5, 0.95, 1)] == [0.1, 0.2, 0.3, 0.3]
