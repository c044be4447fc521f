"""`doctor`: what is found, and why nothing is."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from fibaction.border.abc import Diagnosis
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs.doctor import lines
from tests.cli.conftest import Invoke, Run
from tests.support.ros_domain import own_domain

QUICK = ("--seconds", "0.01")


@pytest.fixture(scope="module", autouse=True)
def domain() -> Iterator[None]:
    """Take a domain that no other test run has."""
    with own_domain():
        yield


def test_nothing_is_found_where_nothing_is_and_the_advice_says_so(invoke: Invoke) -> None:
    done = invoke("doctor", *QUICK)

    assert done.exit_code == ExitCode.UNREACHABLE
    assert "Discovery: range LOCALHOST, from ROS_AUTOMATIC_DISCOVERY_RANGE\n" in done.output
    assert "Participants: none\n" in done.output
    assert "Advice: no datagram of another participant has arrived, and other" in done.output


def test_the_diagnosis_as_json_is_one_value(invoke: Invoke) -> None:
    told = json.loads(invoke("doctor", "dds://?lease=3", "--json", *QUICK).output)

    assert (told["url"], told["found"], told["participants"]) == ("dds://", False, [])
    assert len(told["advice"]) == 1


def test_another_url_is_connected_to(here: Run, tcp: str) -> None:
    code, out, _ = here("doctor", tcp, "-a", "/fibonacci")

    assert code == ExitCode.SUCCEEDED
    assert out.startswith("Actions: 6\n    name ")


def test_an_action_that_is_not_served_has_the_code_of_what_is_not_found(
    here: Run, tcp: str
) -> None:
    code, out, _ = here("doctor", "-a", "dance", url=tcp)

    assert code == ExitCode.UNREACHABLE
    assert out.endswith("Advice: the server answers, and does not serve 'dance'\n")


def test_the_url_before_the_verb_counts(here: Run, nobody: str) -> None:
    code, out, err = here("-u", nobody, "doctor")

    assert (code, out) == (ExitCode.UNREACHABLE, "")
    assert err.startswith(f"Error: no server listens at {nobody}")


def test_each_value_has_a_form_for_readers() -> None:
    facts = {
        "own_ports": {"first_one": 1, "names": ["a", "b"], "none": [], "is": True, "was": False},
        "peers": ["x", {"host": "y"}],
        "rest": [],
    }
    assert list(lines(Diagnosis(False, facts, ("look",)))) == [
        "Own ports: first one 1, names a b, none none, is yes, was no",
        "Peers: 2",
        "    x",
        "    host y",
        "Rest: none",
        "Advice: look",
    ]
