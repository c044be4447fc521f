"""The promises of docs/guarantees.md, the tests that show them, and the faults between the two.

    python -m tests.tools.promises

writes the lists of tests that docs/shown_to_hold.md includes; docs/build.py does this first. A
test names what it shows by a mark: `@pytest.mark.promise("FEEDBACK-2")`. The marks are read from
the source without importing the tests, so the tests that need ROS 2 are found on every machine.
"""

from __future__ import annotations

import argparse
import ast
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
PAGE = ROOT / "docs" / "guarantees.md"
PAGE_OF_TESTS = ROOT / "docs" / "shown_to_hold.md"
LISTS = ROOT / "build" / "guarantee_tests"
"""Folder of the lists that the page of tests includes: one file for each group of promises."""

CONTRACT = ("fibaction/testing/contract/", "tests/contract/")
"""Folders of the contract: its public part, and what needs more than pytest."""
ROS = "tests/ros2/"
LINES = ("tests/transports/", "tests/wire/")
"""Folders of tests for parts that ROS 2 does not use."""

_MARK = "pytest.mark.promise"
_ROW = re.compile(
    r'^\| <nobr id="(?P<anchor>[a-z]+-\d+)">(?P<name>[A-Z]+-\d+)</nobr>'
    r" \| (?P<text>.+) \| (?P<ros>.+) \|$",
    re.MULTILINE,
)
_SECTION = re.compile(r"^## (?P<heading>.+)$(?P<body>(?:\n(?!## ).*)*)", re.MULTILINE)
_ON_ROS = re.compile(r"(?P<kind>Yes|In part|No|Does not arise)(?P<more>: .+)?")


class Promise(NamedTuple):
    """A row of the page."""

    name: str
    text: str
    ros: str
    """The cell about ROS 2: yes, in part or no, and the reason."""
    anchor: str
    """The fragment of a link to it."""

    @property
    def group(self) -> str:
        """The group that it belongs to: `FEEDBACK` of `FEEDBACK-2`."""
        return self.name.partition("-")[0]

    @property
    def number(self) -> int:
        """The number within its group: 2 of `FEEDBACK-2`."""
        return int(self.name.partition("-")[2])


class Proof(NamedTuple):
    """A test, and the promises that it names."""

    test: str
    file: str
    """The path from the root."""
    promises: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file}::{self.test}"


# Reading


def promises_of(page: str) -> list[Promise]:
    """Return the promises of a page, in order."""
    rows = _ROW.finditer(page)
    return [Promise(*row.group("name", "text", "ros", "anchor")) for row in rows]


def headings_of(page: str) -> dict[str, str]:
    """Return the groups of promises of a page, each with the heading that it stands under."""
    return {
        promise.group: section["heading"]
        for section in _SECTION.finditer(page)
        for promise in promises_of(section["body"])
    }


def proofs_in(source: str, file: str) -> Iterator[Proof]:
    """Yield the tests of a module, each with the promises that it names, if any.

    Raises:
        ValueError: An argument of a mark is not a name.
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
    """Return all tests of the contract, and all others that name a promise."""
    proofs: list[Proof] = []
    for path in sorted([*(ROOT / CONTRACT[0]).glob("test_*.py"), *TESTS.rglob("test_*.py")]):
        file = path.relative_to(ROOT).as_posix()
        source = path.read_text(encoding="utf-8")
        if file.startswith(CONTRACT) or f"@{_MARK}" in source:
            found = proofs_in(source, file)
            proofs += (proof for proof in found if proof.promises or file.startswith(CONTRACT))
    return proofs


# Comparing


def faults(
    promises: list[Promise], proofs: list[Proof], left_out: Mapping[str, str]
) -> Iterator[str]:
    """Yield the faults between the promises and their tests, a line for each.

    `left_out` has the tests of the contract that ROS 2 cannot keep, each with the reason, which is
    `TYPE` if only the action of the test cannot be served.
    """
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


def lists_of_tests(promises: Iterable[Promise], proofs: Iterable[Proof]) -> dict[str, str]:
    """Return for each group of promises, in Markdown, each promise with its tests."""
    proofs = list(proofs)
    parts: dict[str, list[str]] = {}
    for promise in promises:
        shown_by = [proof for proof in proofs if promise.name in proof.promises]
        lines = [f"### {promise.name}", "", promise.text, ""]
        lines += [f"- `{proof.test}` in {proof.file}" for proof in shown_by]
        parts.setdefault(promise.group, []).append("\n".join([*lines, ""]))
    return {group: "\n".join(texts) for group, texts in parts.items()}


def write_lists() -> None:
    """Write the lists that docs/shown_to_hold.md includes."""
    shutil.rmtree(LISTS, ignore_errors=True)
    LISTS.mkdir(parents=True)
    promises = promises_of(PAGE.read_text(encoding="utf-8"))
    for group, text in lists_of_tests(promises, all_proofs()).items():
        (LISTS / f"{group}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    argparse.ArgumentParser(
        prog="python -m tests.tools.promises",
        description="Write the lists of tests that docs/shown_to_hold.md includes.",
    ).parse_args()
    write_lists()
