"""docs/guarantees.md: each promise has its tests, each test of the contract its promises."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from tests.contract.conftest import COMBINED, NOT_ON_TRIO, TURNS, WAYS, is_due
from tests.support.contract_over_ros import EXCLUSIONS, MODULES, TYPE
from tests.tools.promises import (
    CONTRACT,
    LISTS,
    PAGE,
    PAGE_OF_TESTS,
    ROOT,
    Promise,
    Proof,
    all_proofs,
    faults,
    headings_of,
    lists_of_tests,
    promises_of,
    proofs_in,
)

OVER_ROS = {test: "TYPE" if why is TYPE else why for test, why in EXCLUSIONS.items()}


def contract(test: str, *promises: str) -> Proof:
    return Proof(test, f"{CONTRACT[0]}test_it.py", promises)


def over_ros(test: str, *promises: str) -> Proof:
    return Proof(test, "tests/ros2/test_it.py", promises)


def on_a_line(test: str, *promises: str) -> Proof:
    return Proof(test, "tests/transports/test_faults.py", promises)


@pytest.fixture(scope="module")
def proofs() -> list[Proof]:
    return all_proofs()


# The ways of a test of the contract

NAMES = [f"test_{number}" for number in range(200)]


@pytest.mark.parametrize("takes_turns", [False, True])
def test_each_test_has_its_turn_on_both_backends_and_with_each_way(takes_turns: bool) -> None:
    all_of_them = {(one, way) for way in WAYS for one in ("asyncio", "trio")}
    possible = all_of_them - {("trio", way) for way in NOT_ON_TRIO}

    for name in NAMES:
        due = {pair for pair in possible if is_due(name, *pair, takes_turns=takes_turns)}
        assert len(due) >= len(possible) / TURNS - 1
        assert {backend for backend, _ in due} == {"asyncio", "trio"}
    for pair in possible:
        number = sum(is_due(name, *pair, takes_turns=takes_turns) for name in NAMES)
        assert number > len(NAMES) / TURNS / 2
    assert not any(
        is_due("test_1", *pair, takes_turns=takes_turns) for pair in all_of_them - possible
    )


def test_a_test_that_does_not_wait_runs_over_each_way_that_is_no_combination() -> None:
    for way in WAYS.keys() - COMBINED:
        assert all(is_due(name, "asyncio", way, takes_turns=False) for name in NAMES)


# The page as it is


def test_the_promises_and_their_tests_name_each_other(proofs: list[Proof]) -> None:
    promises = promises_of(PAGE.read_text(encoding="utf-8"))

    found = list(faults(promises, proofs, OVER_ROS))

    assert not found, "\n".join(found)


def test_every_row_of_the_page_is_a_promise() -> None:
    page = PAGE.read_text(encoding="utf-8")
    heads = ("| Name |", "| --- |")
    rows = [row for row in page.splitlines() if row.startswith("|") and not row.startswith(heads)]

    assert len(rows) == len(promises_of(page))


def test_every_section_links_to_its_tests() -> None:
    page = PAGE.read_text(encoding="utf-8")

    links = re.findall(r"\(shown_to_hold\.md#([\w-]+)\)", page)

    slugs = [heading.lower().replace(" ", "-") for heading in headings_of(page).values()]
    assert links == slugs


def test_the_page_of_tests_includes_the_list_of_each_section() -> None:
    folder = LISTS.relative_to(ROOT).as_posix()
    parts = [
        f'## {heading}\n\n--8<-- "{folder}/{group}.md"\n'
        for group, heading in headings_of(PAGE.read_text(encoding="utf-8")).items()
    ]

    assert PAGE_OF_TESTS.read_text(encoding="utf-8").endswith("\n".join(parts))


def test_every_test_of_a_promise_is_in_a_list(proofs: list[Proof]) -> None:
    lists = lists_of_tests(promises_of(PAGE.read_text(encoding="utf-8")), proofs)

    listed = re.findall(r"^- `(\w+)` in (.+)$", "\n".join(lists.values()), re.MULTILINE)
    assert sorted(listed) == sorted(
        (proof.test, proof.file) for proof in proofs for _ in proof.promises
    )


def modules_of_the_contract() -> set[str]:
    """Return the files that define tests of the contract."""
    files = [path for folder in CONTRACT for path in (ROOT / folder).glob("test_*.py")]
    defining = [path for path in files if "def test_" in path.read_text(encoding="utf-8")]
    return {path.relative_to(ROOT).as_posix() for path in defining}


def test_every_module_of_the_contract_is_looked_at(proofs: list[Proof]) -> None:
    found = {proof.file for proof in proofs if proof.file.startswith(CONTRACT)}

    assert found == modules_of_the_contract()


def test_every_module_of_the_contract_is_run_over_ros() -> None:
    modules = {file.removesuffix(".py").replace("/", ".") for file in modules_of_the_contract()}

    assert set(MODULES) == modules


# What would be wrong is found

ONE = Promise("GOAL-1", "It ends.", "Yes", "goal-1")
TWO = Promise("GOAL-2", "It ends once.", "Yes: by a rule of ROS", "goal-2")
SHOWN = [contract("test_it_ends", "GOAL-1"), contract("test_it_ends_once", "GOAL-1", "GOAL-2")]


def test_promises_and_tests_that_name_each_other_have_no_fault() -> None:
    assert list(faults([ONE, TWO], SHOWN, {})) == []


@pytest.mark.parametrize(
    ("promises", "proofs", "fault"),
    [
        ([ONE, TWO], SHOWN[:1], "GOAL-2 is shown by no test"),
        (
            [ONE],
            SHOWN,
            f"{SHOWN[1]} names GOAL-2, and there is no such promise",
        ),
        (
            [ONE, TWO],
            [*SHOWN, contract("test_more")],
            f"{CONTRACT[0]}test_it.py::test_more names no promise",
        ),
        (
            [ONE, TWO],
            [*SHOWN, SHOWN[0]._replace(file=f"{CONTRACT[0]}test_more.py")],
            "test_it_ends is the name of 2 tests of the contract",
        ),
        ([ONE, TWO, TWO], SHOWN, "GOAL-2 comes after GOAL-2, and numbers only grow"),
        ([TWO, ONE], SHOWN, "GOAL-1 comes after GOAL-2, and numbers only grow"),
        (
            [ONE, Promise("STOP-1", "It stops.", "Yes", "stop-1"), TWO],
            [*SHOWN, contract("test_it_stops", "STOP-1")],
            "the promises of GOAL are not together",
        ),
        ([ONE, TWO._replace(anchor="goal-1")], SHOWN, "GOAL-2 has the anchor goal-1"),
        ([ONE, TWO._replace(text="It ends")], SHOWN, "GOAL-2 is not one sentence"),
        ([ONE, TWO._replace(text="It ends. Once.")], SHOWN, "GOAL-2 is not one sentence"),
    ],
)
def test_a_fault_between_promises_and_tests_is_found(
    promises: list[Promise], proofs: list[Proof], fault: str
) -> None:
    assert list(faults(promises, proofs, {})) == [fault]


@pytest.mark.parametrize("ros", ["", "Maybe", "Yes, mostly", "In part", "No", "No: ", "yes"])
def test_a_promise_that_does_not_say_what_holds_over_ros_is_found(ros: str) -> None:
    assert list(faults([ONE._replace(ros=ros)], SHOWN[:1], {})) == [
        "GOAL-1 does not say whether it holds over ROS 2, or not why"
    ]


@pytest.mark.parametrize("ros", ["Yes", "Yes: by a rule", "In part: not the reason"])
@pytest.mark.parametrize("proof", [contract, on_a_line])
def test_a_promise_that_is_said_to_hold_over_ros_and_is_not_shown_there_is_found(
    proof: Callable[..., Proof], ros: str
) -> None:
    promise = ONE._replace(ros=ros)
    shown = [proof("test_it_ends", "GOAL-1")]
    left_out = {"test_it_ends": "TYPE"} if proof is contract else {}

    fault = "GOAL-1 holds over ROS 2, it says, but no test shows it there"
    assert list(faults([promise], shown, left_out)) == [fault]
    there = over_ros("test_it_ends_there", "GOAL-1")
    assert list(faults([promise], [*shown, there], left_out)) == []


@pytest.mark.parametrize("ros", ["No: it cannot", "Does not arise: there are none"])
@pytest.mark.parametrize("proof", [contract, over_ros])
def test_a_promise_that_is_said_not_to_hold_over_ros_and_is_shown_there_is_found(
    proof: Callable[..., Proof], ros: str
) -> None:
    shown = proof("test_it_ends", "GOAL-1")

    assert list(faults([ONE._replace(ros=ros)], [shown], {})) == [
        f"GOAL-1 does not hold over ROS 2, it says, but {shown} shows it there"
    ]


def test_a_test_that_is_left_out_over_ros_for_no_reason_on_the_page_is_found() -> None:
    assert list(faults([ONE, TWO], SHOWN, {"test_it_ends": "REASON"})) == [
        "test_it_ends is left out over ROS 2, and its promises say nothing of that"
    ]


def test_a_test_that_is_left_out_over_ros_and_is_not_there_is_found() -> None:
    assert list(faults([ONE, TWO], SHOWN, {"test_gone": "REASON"})) == [
        "test_gone is left out over ROS 2, and there is no such test"
    ]


# How both are read


def test_the_marks_of_a_module_are_read_without_running_it() -> None:
    mark = '@pytest.mark.promise("GOAL-1", "GOAL-2")\n@pytest.mark.anyio\n'
    module = f"{mark}async def test_one(): ...\ndef test_two(): ...\ndef helper(): ...\n"
    assert list(proofs_in(module, "test_it.py")) == [
        Proof("test_one", "test_it.py", ("GOAL-1", "GOAL-2")),
        Proof("test_two", "test_it.py", ()),
    ]


@pytest.mark.parametrize("names", ["NAME", "1", '*["GOAL-1"]', 'name="GOAL-1"'])
def test_a_mark_whose_names_cannot_be_read_is_refused(names: str) -> None:
    with pytest.raises(ValueError, match="names of promises only"):
        list(proofs_in(f"@pytest.mark.promise({names})\ndef test_it(): ...", "test_it.py"))
