"""The promises of docs/guarantees.md, the tests that show them, and what is wrong between the two.

    python -m tests.promises

writes the names of the tests into the page. A test says what it shows by its mark:
`@pytest.mark.promise("FEEDBACK-2")`. No test is imported to find that out, so those that need ROS 2
are found where there is none.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "guarantees.md"
CONTRACT = "tests/contract/"
ROS = "tests/ros2/"
LINES = ("tests/transports/", "tests/wire/")
"""Tests of what ROS 2 does not use."""

_MARK = "pytest.mark.promise"
_ROW = re.compile(
    r'^\| <nobr id="(?P<anchor>[a-z]+-\d+)">(?P<name>[A-Z]+-\d+)</nobr>'
    r" \| (?P<text>.+) \| (?P<ros>.+) \|$",
    re.MULTILINE,
)
_LIST = re.compile(
    r"^<!-- tests of (?P<group>[A-Z]+): made by tests/promises\.py -->$.*?^<!-- end of tests -->$",
    re.DOTALL | re.MULTILINE,
)
_ON_ROS = re.compile(r"(?P<kind>Yes|In part|No|Does not arise)(?P<more>: .+)?")


class Promise(NamedTuple):
    """A row of the page."""

    name: str
    text: str
    ros: str
    """Whether it holds over ROS 2, and by which rule."""
    anchor: str
    """What a link to it ends with."""

    @property
    def group(self) -> str:
        """The part of the page that it belongs to: `FEEDBACK` of `FEEDBACK-2`."""
        return self.name.partition("-")[0]

    @property
    def number(self) -> int:
        """Its number there: 2 of `FEEDBACK-2`."""
        return int(self.name.partition("-")[2])


class Proof(NamedTuple):
    """A test, and the promises that it names."""

    test: str
    file: str
    """Where it is, from the root."""
    promises: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file}::{self.test}"


# Reading


def promises_of(page: str) -> list[Promise]:
    """The promises of a page, in order."""
    rows = _ROW.finditer(_LIST.sub("", page))
    return [Promise(*row.group("name", "text", "ros", "anchor")) for row in rows]


def proofs_in(source: str, file: str) -> Iterator[Proof]:
    """The tests of a module, each with the promises that it names, if any.

    Raises:
        ValueError: A mark has something else than names.
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name[:5] == "test_":
            names = [name for decorator in node.decorator_list for name in _names_in(decorator)]
            yield Proof(node.name, file, tuple(names))


def _names_in(decorator: ast.expr) -> list[str]:
    if not isinstance(decorator, ast.Call) or ast.unparse(decorator.func) != _MARK:
        return []
    names = [one.value for one in decorator.args if isinstance(one, ast.Constant)]
    texts = [name for name in names if isinstance(name, str)]
    if len(texts) < len(decorator.args) or decorator.keywords:
        raise ValueError(f"a mark has names of promises only, and not {ast.unparse(decorator)}")
    return texts


def all_proofs() -> list[Proof]:
    """All tests of the contract, and all others that name a promise."""
    proofs: list[Proof] = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        file = path.relative_to(ROOT).as_posix()
        source = path.read_text(encoding="utf-8")
        if file.startswith(CONTRACT) or f"@{_MARK}" in source:
            found = proofs_in(source, file)
            proofs += (proof for proof in found if proof.promises or file.startswith(CONTRACT))
    return proofs


def left_out_over_ros(source: str) -> dict[str, str]:
    """The tests of the contract that ROS 2 cannot keep, each with the name of the reason: what
    `EXCLUSIONS` is in tests/ros2/test_contract.py, which cannot be imported without ROS 2.
    """
    for node in ast.parse(source).body:
        match node:
            case ast.AnnAssign(target=ast.Name("EXCLUSIONS"), value=ast.Dict(keys, values)):
                names = [ast.literal_eval(key) for key in keys if key is not None]
                return dict(zip(names, map(ast.unparse, values), strict=True))
    raise ValueError("there is no EXCLUSIONS")


# Comparing


def faults(
    promises: list[Promise], proofs: list[Proof], left_out: Mapping[str, str]
) -> Iterator[str]:
    """What is wrong with the promises and their tests, a line for each."""
    yield from _faults_of_names(promises)
    known = {promise.name for promise in promises}
    for proof in proofs:
        if not proof.promises:
            yield f"{proof} names no promise"
        for name in proof.promises:
            if name not in known:
                yield f"{proof} names {name}, and there is no such promise"
    for promise in promises:
        shown_by = [proof for proof in proofs if promise.name in proof.promises]
        if shown_by:
            yield from _faults_over_ros(promise, shown_by, left_out)
        else:
            yield f"{promise.name} is shown by no test"
    yield from _faults_of_what_is_left_out(promises, proofs, left_out)
    contract = Counter(proof.test for proof in proofs if proof.file.startswith(CONTRACT))
    for test, count in contract.items():
        if count > 1:  # over ROS 2 all are in one module, where one would replace the other
            yield f"{test} is the name of {count} tests of the contract"


def _faults_of_names(promises: list[Promise]) -> Iterator[str]:
    for before, promise in pairwise(promises):
        if promise.group == before.group and promise.number <= before.number:
            yield f"{promise.name} comes after {before.name}, and numbers only grow"
    groups = [promise.group for promise in promises]
    begun = [group for before, group in pairwise(["", *groups]) if group != before]
    for group in sorted(set(begun)):
        if begun.count(group) > 1:
            yield f"the promises of {group} are not together"
    for promise in promises:
        if promise.anchor != promise.name.lower():
            yield f"{promise.name} has the anchor {promise.anchor}"
        if not promise.text.endswith(".") or ". " in promise.text:
            yield f"{promise.name} is not one sentence"


def _faults_over_ros(
    promise: Promise, shown_by: Iterable[Proof], left_out: Mapping[str, str]
) -> Iterator[str]:
    said = _ON_ROS.fullmatch(promise.ros)
    if said is None or (said["kind"] != "Yes" and not said["more"]):
        yield f"{promise.name} does not say whether it holds over ROS 2, or not why"
        return
    contract = [proof for proof in shown_by if proof.file.startswith(CONTRACT)]
    there = [proof for proof in contract if proof.test not in left_out]
    there += [proof for proof in shown_by if proof.file.startswith(ROS)]
    if said["kind"] in ("No", "Does not arise"):
        for proof in there:
            yield f"{promise.name} does not hold over ROS 2, it says, but {proof} shows it there"
    elif not there and (contract or all(proof.file.startswith(LINES) for proof in shown_by)):
        yield f"{promise.name} holds over ROS 2, it says, but no test shows it there"


def _faults_of_what_is_left_out(
    promises: Iterable[Promise], proofs: Iterable[Proof], left_out: Mapping[str, str]
) -> Iterator[str]:
    unlimited = {promise.name for promise in promises if promise.ros.startswith("Yes")}
    tests = {proof.test: proof for proof in proofs if proof.file.startswith(CONTRACT)}
    for test, reason in left_out.items():
        if test not in tests:
            yield f"{test} is left out over ROS 2, and there is no such test"
        # That test's action has no ROS type: a need of the test, and not of what it shows.
        elif reason != "TYPE" and unlimited.issuperset(tests[test].promises):
            yield f"{test} is left out over ROS 2, and its promises say nothing of that"


# Writing


def with_tests(page: str, proofs: list[Proof]) -> str:
    """The page, with the names of the tests between its marks made anew.

    Raises:
        ValueError: A group of promises has no such marks, or marks have no promises.
    """
    promises = promises_of(page)
    groups = list(dict.fromkeys(promise.group for promise in promises))
    if groups != [found["group"] for found in _LIST.finditer(page)]:
        raise ValueError("each group of promises has one list of tests, in the same order")

    def make(found: re.Match[str]) -> str:
        group = [promise.name for promise in promises if promise.group == found["group"]]
        lines = [f"<!-- tests of {found['group']}: made by tests/promises.py -->", ""]
        lines += ['<details markdown="1">', "<summary>Tests</summary>", ""]
        for name in group:
            lines.append(f"- {name}")
            shown_by = [proof for proof in proofs if name in proof.promises]
            lines += [f"    - `{proof.test}` in {proof.file}" for proof in shown_by]
        lines += ["", "</details>", "", "<!-- end of tests -->"]
        return "\n".join(lines)

    return _LIST.sub(make, page)


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python -m tests.promises",
        description="Write the names of the tests into docs/guarantees.md.",
    ).parse_args()
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_tests(text, all_proofs()), encoding="utf-8")
