"""What docs/comparisons.md shows is what was measured, and says on what."""

from __future__ import annotations

import copy
import re
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.support.page_parts import part_of
from tests.tools.benchmarks import functions, pages, pythons, suite
from tests.tools.benchmarks.memory import MEASURED
from tests.tools.benchmarks.pictures import PICTURES, picture
from tests.tools.benchmarks.starting import STARTS
from tests.tools.benchmarks.versions import ORDERS
from tests.tools.benchmarks.ways import WAYS
from tests.tools.drawing import Bar, Panel, bars

REPORTS = suite.read()
LONGEST_LABEL = 30
"""Characters: a longer one would run into its bar."""

every_report = pytest.mark.parametrize("name", REPORTS)


def test_each_comparison_has_a_report_a_picture_and_a_table() -> None:
    assert set(REPORTS) == set(PICTURES) == set(pages.TABLES)


def test_the_tables_of_the_page_are_made_of_the_reports() -> None:
    page = pages.PAGE.read_text(encoding="utf-8")

    assert pages.with_tables(page, REPORTS) == page


def test_the_page_has_a_row_for_each_work_of_pythons_and_of_functions() -> None:
    page = pages.PAGE.read_text(encoding="utf-8")
    of_pythons, of_functions = (
        part_of(page, name, f"python -m tests.tools.benchmarks.{name}")
        for name in ("pythons", "functions")
    )
    for order in ORDERS:
        where, _, work = order.partition(" ")
        assert f"| fibaction, {where}: {pythons.NAMES[work]} | " in of_pythons
        assert f"| {functions.PLACES[where]}, {functions.KINDS[work]} | " in of_functions


def test_a_cell_of_pythons_has_the_median_and_where_half_of_the_ratios_are() -> None:
    made = pythons.table({"tcp batches": {"3.12.1": [1.0, 1.25, 1.5]}}, "3.11.7")
    assert made.splitlines()[0].endswith("to that with 3.11.7 (more than 1: faster) | 3.12.1 |")
    assert made.splitlines()[2] == "| fibaction, tcp: 500 at once | 1.25 (1.00 to 1.50) |"


@every_report
def test_the_picture_is_made_of_the_report(name: str) -> None:
    assert (suite.FOLDER / f"{name}.svg").read_text(encoding="utf-8") == picture(REPORTS[name])


def test_all_reports_are_of_one_run() -> None:
    about = [
        {key: report[key] for key in ("date", "command", "machine", "versions", "left_out")}
        for report in REPORTS.values()
    ]

    assert all(one == about[0] for one in about)


@every_report
def test_who_is_not_compared_was_left_out_by_name(name: str) -> None:
    report = REPORTS[name]
    shown = {
        "start": {key for key, start in STARTS.items() if start.needs},
        "memory": {key for key in MEASURED if not WAYS[key].is_ours},
    }.get(name, set(WAYS))

    there = {key.partition("_")[0] if name == "memory" else key for key in report["ways"]}

    for key in shown - there:
        way = STARTS[key].needs if name == "start" else key
        assert report["left_out"][WAYS[way].label]


@every_report
def test_a_picture_is_well_formed_and_shows_every_way_with_a_number(name: str) -> None:
    root = ElementTree.fromstring(picture(REPORTS[name]))
    texts = [element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text")]

    for values in REPORTS[name]["ways"].values():
        assert values["label"] in texts
        assert len(values["label"]) <= LONGEST_LABEL
    assert sum(bool(re.search(r"\d", text)) for text in texts) >= len(REPORTS[name]["ways"])


def test_a_bar_that_is_far_longer_than_all_others_is_cut() -> None:
    long = [Bar("a", 100, "100", False), Bar("b", 2, "2", True), Bar("c", 1, "1", True)]

    drawn = bars("t", "s", [Panel("p", long)])

    first, second, third = map(float, re.findall(r'<rect x="236".* width="([\d.]+)"', drawn))
    assert first < 2 * second
    assert second == pytest.approx(2 * third, abs=0.2)  # they are drawn to tenths
    assert drawn.count('fill="#ffffff"/>') == 1


def test_goals_of_a_batch_that_were_lost_are_shown_in_place_of_a_rate() -> None:
    report: dict[str, Any] = copy.deepcopy(REPORTS["goals_at_once"])
    lost = {"answered": 17, "of": 500, "seconds": 10}
    report["ways"] = {"rclpy": {"label": "rclpy", "group": "ROS", "ours": False, **lost}}
    report["ratios"] = []

    assert "17 of 500 answered" in picture(report)
    assert "| rclpy | 17 of 500 answered in 10 s |" in pages.table(report)


def test_a_way_that_has_lost_all_feedback_is_shown_without_a_number() -> None:
    report: dict[str, Any] = copy.deepcopy(REPORTS["feedback_latency"])
    first = next(iter(report["ways"].values()))
    first["seen"] = {"p50": None, "p90": None, "p99": None, "p99.9": None, "samples": 0}

    assert "all were lost" in picture(report)
    assert " – | – | – | – | 0 |" in pages.table(report)  # noqa: RUF001  # as in the tables
