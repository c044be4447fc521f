"""Text of a peer, made safe to log and to keep."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fibaction._runtime.text import LENGTH, REASON, excerpt, printable, shortened

TEXTS = st.text(max_size=3 * LENGTH)


@given(TEXTS)
def test_an_excerpt_is_one_printable_line_of_limited_length(text: str) -> None:
    short = excerpt(text)

    assert short.isprintable()
    assert len(short) <= LENGTH
    assert excerpt(short) == short


@given(st.text(st.characters(categories=["L", "N", "P"]), max_size=LENGTH))
def test_a_short_printable_text_is_its_own_excerpt(text: str) -> None:
    assert excerpt(text) == text


def test_an_excerpt_shows_that_it_was_cut() -> None:
    assert excerpt("x" * 10_000_000) == "x" * (LENGTH - 1) + "…"


def test_what_is_cut_is_not_escaped_first() -> None:
    assert len(excerpt("\n" * 10_000_000, 10)) == 10


def test_a_newline_and_an_escape_are_shown_as_escapes() -> None:
    assert printable("a\n\x1b[2Jb\u202e") == "a\\x0a\\x1b[2Jb\\u202e"


def test_a_reason_is_cut_and_not_escaped() -> None:
    assert shortened("a\n" * REASON) == ("a\n" * REASON)[: REASON - 1] + "…"
    assert shortened("\x1b" * REASON) == "\x1b" * REASON
