"""The fenced blocks of the documentation's pages.

A page may have several programs, each with files, names and terminals of its own: the mark
`<!-- new program -->` stands where the next one begins.
"""

from __future__ import annotations

import re
from typing import NamedTuple

FENCED = re.compile(r"^```(?P<info>[^\n]*)\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
NOT_RUN = re.compile(r"<!-- not run: (?P<reason>.*?) -->\n\Z", re.DOTALL)

_NEW_PROGRAM = "<!-- new program -->\n"


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    code: str
    line: int
    before: str
    """The text between this block and the one before it, or the start of the page."""


def blocks_of(page: str) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    blocks: list[Block] = []
    end = 0
    for match in FENCED.finditer(page):
        line = page.count("\n", 0, match.start("code"))
        before = page[end : match.start()]
        blocks.append(Block(match["info"], match["code"], line, before))
        end = match.end()
    return blocks


def programs_of(page: str) -> list[str]:
    """Return the parts of a page with a program each; their lines have the numbers of the page."""
    first, *others = page.split(_NEW_PROGRAM)
    programs = [first]
    line = first.count("\n")
    for part in others:
        programs.append("\n" * (line + 1) + part)
        line += 1 + part.count("\n")
    return programs
