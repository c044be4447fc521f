"""Parts of a page that are made from the code: where they stand, and tables in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence


def with_parts(page: str, parts: Mapping[str, Callable[[], str]]) -> str:
    """The page, with what stands between its markers made anew.

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
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
