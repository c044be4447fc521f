"""The speed under each version of Python, as its page shows it."""

from __future__ import annotations

import platform

from tests.support.page_parts import part_of
from tests.tools.benchmarks import pythons
from tests.tools.benchmarks.pages import PAGE
from tests.tools.benchmarks.pythons import table
from tests.tools.benchmarks.versions import ORDERS

HERE = platform.python_version()


def test_a_cell_has_the_median_and_where_half_of_the_ratios_are() -> None:
    made = table({"tcp batches": {"3.12.1": [1.0, 1.25, 1.5]}}, "3.11.7")
    assert made.splitlines()[0].endswith("to that with 3.11.7 (more than 1: faster) | 3.12.1 |")
    assert made.splitlines()[2] == "| fibaction, tcp: 500 at once | 1.25 (1.00 to 1.50) |"


def test_the_page_has_a_row_for_each_work() -> None:
    page = PAGE.read_text(encoding="utf-8")
    made = part_of(page, "pythons", "python -m tests.tools.benchmarks.pythons")
    for order in ORDERS:
        where, _, work = order.partition(" ")
        assert f"| fibaction, {where}: {pythons.NAMES[work]} | " in made
