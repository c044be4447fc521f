"""The cost of one message of each kind: bounded, and shown on the page."""

from __future__ import annotations

import re

import pytest

from tests.support.page_parts import part_of
from tests.tools.benchmarks.costs import KINDS, costs, too_dear
from tests.tools.benchmarks.pages import PAGE

GOALS = 300
"""Active goals at the server, which make only the requests about all goals dearer."""


@pytest.mark.asyncio
async def test_no_message_costs_more_than_its_limit() -> None:
    assert too_dear(await costs(GOALS), GOALS) == []


def test_the_table_of_the_page_has_each_kind() -> None:
    part = part_of(
        PAGE.read_text(encoding="utf-8"), "costs", "python -m tests.tools.benchmarks.costs"
    )

    assert re.findall(r"^\| (`.*?) \| [\d,]+ \| [\d,]+ \|$", part, re.MULTILINE) == [
        kind.name for kind in KINDS
    ]
