"""What docs/shown_to_hold.md shows is what was measured."""

from __future__ import annotations

from tests.tools.benchmarks import size_page
from tests.tools.benchmarks.pages import NOTHING
from tests.tools.benchmarks.size_page import Direction, Report, Series
from tests.tools.benchmarks.sizes import PLANS

REPORT = size_page.read()


def test_each_direction_is_measured_to_its_largest_size() -> None:
    measured = {one.name: list(one.sizes) for one in REPORT.directions}
    assert measured == {name: plan.sizes for name, plan in PLANS.items()}


def test_the_tables_of_the_page_are_made_of_the_report() -> None:
    page = size_page.PAGE.read_text(encoding="utf-8")
    assert size_page.page_of(page, REPORT) == page


def test_the_picture_is_made_of_the_report() -> None:
    drawn = (size_page.FOLDER / "sizes.svg").read_text(encoding="utf-8")
    assert size_page.picture(REPORT) == drawn


def test_a_figure_that_says_nothing_is_a_dash_and_no_bar() -> None:
    series = Series("Each megabyte", "µs", [None, 200.0, 400.0])
    direction = Direction("payloads", "bytes", [1, 10**6, 10**7], [series])
    row = size_page.table(direction).splitlines()[-1]
    assert row == f"| Each megabyte | {NOTHING} | 200 µs | 400 µs | 2 |"
    drawn = size_page.picture(Report("a machine", "2026-01-01", [direction]))
    assert drawn.count("<rect") == size_page.picture(
        Report("", "", [direction._replace(sizes=[1, 2], series=[Series("s", "µs", [1.0, 2.0])])])
    ).count("<rect")
