"""The parts of the documentation that programs fill in."""

from __future__ import annotations

import pytest

from tests.support.page_parts import part_of, with_part

PAGE = (
    "# A page\n\n<!-- costs: made by make bench -->\n\nnone\n\n<!-- end of costs -->\n\nThe end.\n"
)


def test_a_part_is_replaced_and_the_rest_of_the_page_stays() -> None:
    page = with_part(PAGE, "costs", "make bench", "| 1 | 2 |")

    assert page == PAGE.replace("none", "| 1 | 2 |")
    assert part_of(page, "costs", "make bench") == "| 1 | 2 |"


@pytest.mark.parametrize(
    "page", ["# A page\n", PAGE.replace("end of", ""), PAGE.replace("make bench", "make costs")]
)
def test_a_page_without_the_comments_is_an_error(page: str) -> None:
    with pytest.raises(ValueError, match="the page has no part for 'costs'"):
        with_part(page, "costs", "make bench", "")
