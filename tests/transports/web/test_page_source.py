"""`fibaction_transports.web.http.page_source`: what is left out of a page, and what stays."""

from __future__ import annotations

from importlib.resources import files
from importlib.resources.abc import Traversable

import pytest

from fibaction_transports.web.http.assets import CLIENT, all_assets
from fibaction_transports.web.http.page_source import COMMENTED, as_served

SOURCES = [
    (f"/{path}/{one.name}", one)
    for path, folder in (("console", "console"), ("docs", "api_page"))
    for one in (files("fibaction_transports.web") / folder).iterdir()
    if one.name.endswith(COMMENTED)
]


def test_comments_that_are_lines_are_left_out_and_the_others_stay() -> None:
    source = b"""/** One. */
/**
 * Two ** lines * / of it.
 */
const url = "http://x"; // at the end of a line
  // a line of it
  /* another */ const star = "/* no comment */";
  /** Before a method. */
  go() {}
"""
    left = b"""



const url = "http://x"; // at the end of a line

/* another */ const star = "/* no comment */";

go() {}
"""
    assert as_served(source) == left


@pytest.mark.parametrize(("path", "file"), SOURCES)
def test_each_line_of_a_page_is_as_in_its_file_or_was_a_comment(
    path: str, file: Traversable
) -> None:
    lines = [line.strip() for line in file.read_text().split("\n")]
    served = all_assets()[path].body.decode().split("\n")
    assert len(served) == len(lines)
    gone = [line for line, now in zip(lines, served, strict=True) if line != now]
    assert all(line.startswith(("/*", "*", "//")) for line in gone)


@pytest.mark.parametrize(("path", "file"), SOURCES)
def test_no_text_of_a_page_has_several_lines(path: str, file: Traversable) -> None:
    lines = file.read_text().split("\n")
    assert [line for line in lines if line.count("`") % 2] == []


def test_the_client_for_javascript_is_served_with_its_comments() -> None:
    for name in CLIENT:
        whole = files("fibaction_transports.web") / "javascript" / name
        assert all_assets()[f"/{name}"].body == whole.read_bytes()
