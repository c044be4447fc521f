"""How expressions of Python are laid out in lines: as ruff does it.

A group that has been broken has a comma behind its last item, so that it stays broken.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

WIDTH = 88
"""Columns of a line: what ruff has unless told otherwise."""


class Group(NamedTuple):
    """What stands between brackets, in one line or in a line for each item."""

    before: str
    items: list[Node]
    after: str


class Text(NamedTuple):
    """A string, in one line or in several."""

    before: str
    text: str


Node: TypeAlias = Group | Text | str


def quoted(text: str) -> str:
    """A string as Python writes it, in the quotes that ruff would choose."""
    return requoted(repr(text))


def requoted(literal: str) -> str:
    """A literal in double quotes, where that takes no more of backslashes."""
    inner = literal[1:-1]
    if literal[0] == '"' or inner.count('"') > inner.count("'"):
        return literal
    inner = inner.replace("\\'", "'").replace('"', '\\"')
    return f'"{inner}"'


def flat(node: Node) -> str:
    """A node in one line."""
    if isinstance(node, Text):
        return node.before + quoted(node.text)
    if isinstance(node, Group):
        return node.before + ", ".join(map(flat, node.items)) + node.after
    return node


def laid_out(before: str, node: Node, after: str, indent: int) -> list[str]:
    """A node in one line, or if that is too long, in several."""
    line = " " * indent + before + flat(node) + after
    if len(line) > WIDTH:
        if isinstance(node, Group):
            return broken(before, node, after, indent)
        if isinstance(node, Text) and node.text:
            space = " " * indent
            parts = [f"{space}    {quoted(part)}" for part in _parts(node.text, indent + 4)]
            return [f"{space}{before}{node.before}(", *parts, f"{space}){after}"]
    return [line]


def broken(before: str, group: Group, after: str, indent: int) -> list[str]:
    """A group in a line for each item, and one for each bracket."""
    space = " " * indent
    lines = [f"{space}{before}{group.before}"]
    for item in group.items:
        lines += laid_out("", item, ",", indent + 4)
    return [*lines, f"{space}{group.after}{after}"]


def _parts(text: str, indent: int) -> Iterator[str]:
    """A text in parts that fit into a line each, broken at its own lines and at spaces."""
    width = WIDTH - indent
    if len(quoted(text)) <= width:
        yield text
        return
    for line in text.splitlines(keepends=True):
        part = ""
        for word in re.findall(r"\s*\S+\s*$|\s*\S+|\s+$", line):
            if part and len(quoted(part + word)) > width:
                yield part
                part = ""
            part += word
        yield part
