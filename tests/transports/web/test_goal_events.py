"""`fibaction_transports.web.rest.goal_events`."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction.border.http_access import Refused
from fibaction_transports.web.rest.goal_events import Cursor, cursor_of


@given(st.integers(0, 2**53), st.integers(1, 10**6))
def test_a_cursor_is_read_as_it_was_written(number: int, attempt: int) -> None:
    cursor = Cursor(number, attempt)
    assert cursor_of(str(cursor)) == cursor


def test_the_first_attempt_needs_no_number() -> None:
    assert str(Cursor(17)) == "17"
    assert str(Cursor(17, 2)) == "2.17"


@pytest.mark.parametrize("text", ["", "x", "-1", "1.2.3", "0.1", "1.", "٣", "9" * 19])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(Refused, match="is like 17") as refused:
        cursor_of(text)
    assert refused.value.status == 400
