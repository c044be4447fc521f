from __future__ import annotations

from fibaction import Return


def test_it_shows_the_value_that_it_marks() -> None:
    assert repr(Return([1])) == "Return([1])"
    assert Return("x").value == "x"
