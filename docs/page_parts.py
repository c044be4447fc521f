"""Markers around the parts of a page that are made from the code, and tables in Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence


def with_parts(page: str, parts: Mapping[str, Callable[[], str]]) -> str:
    """Return the page with new text between its markers.

    Raises:
        ValueError: A pair of markers is missing.
    """
    for name, make in parts.items():
        start, end = f"<!-- {name}: made by docs/build.py -->", f"<!-- end of {name} -->"
        before, found, rest = page.partition(start)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ValueError(f"the page has no part for {name!r}")
        page = f"{before}{start}\n\n{make()}\n\n{end}{after}"
    return page


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
