"""The speed under each version of Python, as its page shows it."""

from __future__ import annotations

import json
import platform
import sys
from pathlib import Path

import anyio
import pytest

from tests.support.page_parts import part_of
from tests.tools.benchmarks import pythons
from tests.tools.benchmarks.pages import PAGE
from tests.tools.benchmarks.pythons import compare, found, table
from tests.tools.benchmarks.versions import ORDERS

HERE = platform.python_version()


def environment(folder: Path, name: str, *about: str) -> Path:
    """An environment whose Python says this of itself."""
    python = folder / name / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(f"#!/bin/sh\necho '{json.dumps(about)}'\n")
    python.chmod(0o755)
    return python


def libraries() -> list[str]:
    from importlib.metadata import version

    return [version("anyio"), version("msgspec")]


def test_the_environments_are_found_in_the_order_of_their_versions(tmp_path: Path) -> None:
    ten = environment(tmp_path, "python3.10", "3.10.1", *libraries())
    nine = environment(tmp_path, "python3.9", "3.9.1", *libraries())
    environment(tmp_path, "lowest", "3.8.1", *libraries())
    assert list(found(tmp_path).items()) == [
        (HERE, Path(sys.executable)),
        ("3.9.1", nine),
        ("3.10.1", ten),
    ]


def test_an_environment_with_other_libraries_is_not_compared(tmp_path: Path) -> None:
    environment(tmp_path, "python3.99", "3.99.0", "1.0", "2.0")
    with pytest.raises(SystemExit, match=r"python3\.99, and make it again"):
        found(tmp_path)


def test_the_versions_work_in_turns_and_have_ratios_to_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pythons, "WARM_UP", 0)
    monkeypatch.setattr("tests.tools.benchmarks.versions.WORK", dict.fromkeys(pythons.NAMES, 1))
    here = Path(sys.executable)
    ratios = anyio.run(compare, {"3.0": here, "3.1": here}, 2)
    assert set(ratios) == set(ORDERS)
    for of_versions in ratios.values():
        assert len(of_versions["3.1"]) == 2
        assert min(of_versions["3.1"]) > 0


def test_a_cell_has_the_median_and_where_half_of_the_ratios_are() -> None:
    made = table({"tcp batches": {"3.12.1": [1.0, 1.25, 1.5]}}, "3.11.7")
    assert made.splitlines()[0].endswith("to that with 3.11.7 (more than 1: faster) | 3.12.1 |")
    assert made.splitlines()[2] == "| fibaction, tcp: 500 at once | 1.25 (1.00 to 1.50) |"


def test_the_page_has_a_row_for_each_work() -> None:
    page = PAGE.read_text(encoding="utf-8")
    made = part_of(page, *pythons.PART)
    for order in ORDERS:
        where, _, work = order.partition(" ")
        assert f"| fibaction, {where}: {pythons.NAMES[work]} | " in made
