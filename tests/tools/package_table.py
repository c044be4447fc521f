"""The table of packages in CONTRIBUTING.md, made from the first lines of their docstrings.

`python -m tests.tools.package_table` writes it.
"""

from __future__ import annotations

import ast
from pathlib import Path

from tests.tools.structure import ROOT, SOURCES

PAGE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- packages: python -m tests.tools.package_table -->", "<!-- end of packages -->"


def duties(root: Path = ROOT) -> dict[str, str]:
    """Return the first paragraph of the docstring of each package, on one line or on several."""
    return {
        f"{path.parent.relative_to(root).as_posix()}/": _first_paragraph(path)
        for source in SOURCES
        for path in sorted((root / source).rglob("__init__.py"))
    }


def _first_paragraph(path: Path) -> str:
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n\n")[0]


def faults(duties: dict[str, str]) -> list[str]:
    """Return a sentence for each package whose docstring does not begin with its duty."""
    sentences = []
    for package, duty in duties.items():
        if not duty:
            sentences.append(f"{package} has no docstring: state its duty in one sentence")
        elif "\n" in duty or not duty.endswith(".") or ". " in duty:
            sentences.append(
                f"{package} begins with more or less than a sentence on a line: {duty}"
            )
    return sentences


def table(duties: dict[str, str]) -> str:
    """Return the rows of the packages, with their heading."""
    rows = [f"| `{package}` | {duty.removesuffix('.')} |" for package, duty in duties.items()]
    return "\n".join(["| Package | Its duty |", "| --- | --- |", *rows])


def parts_of(page: str) -> tuple[str, str, str]:
    """Return the text before the table, the table, and the text after it.

    Raises:
        ValueError: The page has no place for the table.
    """
    before, begin, rest = page.partition(BEGIN)
    inner, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page needs the lines {BEGIN} and {END} around the table")
    return before + begin, inner.strip(), end + after


def rewritten(page: str, duties: dict[str, str]) -> str:
    """Return the page with the table of today."""
    before, _, after = parts_of(page)
    return f"{before}\n\n{table(duties)}\n\n{after}"


def main() -> None:
    """Write the table into the page."""
    PAGE.write_text(rewritten(PAGE.read_text(encoding="utf-8"), duties()), encoding="utf-8")


if __name__ == "__main__":
    main()
