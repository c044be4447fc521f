"""The reference of `fibaction.js`, from the declarations of its types."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from page_parts import table

DECLARATIONS = (
    Path(__file__).resolve().parent.parent
    / "transports/fibaction_transports/web/javascript/fibaction.d.ts"
)
FIRST = ("Connection", "Goal")
_COMMENT = r"/\*\*(?P<comment>(?:[^*]|\*(?!/))*)\*/\s*"
_BEFORE = re.compile(_COMMENT + r"\Z")
_EXPORT = re.compile(r"^export (?:class|interface) (\w+).*$", re.MULTILINE)
_MEMBER = re.compile(rf"^  (?:{_COMMENT})?(?P<text>[^\s/*](?:[^;{{]|\{{[^}}]*\}})*);", re.MULTILINE)
_GENERICS = re.compile(r"<\s*\n.*?\n\s*>\(", re.DOTALL)


def reference_part() -> str:
    """Return the classes and the interfaces of the module, each with its members in a table."""
    found = dict(_described(DECLARATIONS.read_text(encoding="utf-8")))
    names = sorted(found, key=lambda name: name not in FIRST)
    return "\n\n".join(f"#### {name}\n\n{found[name]}" for name in names)


def _described(source: str) -> Iterator[tuple[str, str]]:
    for export in _EXPORT.finditer(source):
        if export[0].endswith("{}"):  # an error without fields of its own
            continue
        body = source[export.start() :].partition("{\n")[2].partition("\n}")[0]
        rows = [
            (f"`{_line(_GENERICS.sub('(', one['text']))}`", _line(one["comment"] or ""))
            for one in _MEMBER.finditer(body)
        ]
        comment = _BEFORE.search(source[: export.start()])
        base = re.search(r"extends (\w+) \{", export[0])
        told = [_line(comment["comment"])] if comment else []
        told += [f"In addition to what `{base[1]}` has:"] if base else []
        yield export[1], "\n\n".join([*told, table(["Member", "What it is"], rows)])


def _line(text: str) -> str:
    """Return a text of several lines as one, as a cell of a table has it."""
    text = re.sub(r"\s*(?:\n[ *]*)+", " ", text).strip(" *").removeprefix("readonly ")
    return text.replace("( ", "(").replace(", )", ")").replace(" )", ")").replace("|", "\\|")
