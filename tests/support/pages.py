"""The fenced blocks of the documentation's pages."""

from __future__ import annotations

import re
from typing import NamedTuple

FENCED = re.compile(r"^```(?P<info>[^\n]*)\n(?P<code>.*?)^```$", re.DOTALL | re.MULTILINE)
NOT_RUN = re.compile(r"<!-- not run: (?P<reason>.*?) -->\n\Z", re.DOTALL)


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
