"""The table of packages in CONTRIBUTING.md, made from the first lines of their docstrings.

`python -m tests.tools.package_table` writes it.
"""

from __future__ import annotations

import ast
from pathlib import Path

from tests.support.page_parts import markdown_table, with_part
from tests.tools.structure import ROOT, SOURCES

PAGE = ROOT / "CONTRIBUTING.md"
MAKER = "python -m tests.tools.package_table"


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
    """Return the table of the packages."""
    rows = [[f"`{package}`", duty.removesuffix(".")] for package, duty in duties.items()]
    return markdown_table(["Package", "Its duty"], rows, numbers=False)


def main() -> None:
    """Write the table into the page."""
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_part(page, "packages", MAKER, table(duties())), encoding="utf-8")


if __name__ == "__main__":
    main()
