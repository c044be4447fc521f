"""Parts of the documentation that programs fill in, each between two comments."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def part_of(page: str, name: str, maker: str) -> str:
    """Return the text in the part of that name, which `maker` makes.

    Raises:
        ValueError: The page has no such part.
    """
    return _split(page, name, maker)[1].strip()


def with_part(page: str, name: str, maker: str, text: str) -> str:
    """Return the page with another text in a part.

    Raises:
        ValueError: As for `part_of`.
    """
    before, _, after = _split(page, name, maker)
    return f"{before}\n\n{text}\n\n{after}"


def markdown_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = True
) -> str:
    """Return a table. With `numbers`, all columns but the first are aligned to the right, to be
    compared.
    """
    lines = [head, ["---"] + ["---:" if numbers else "---"] * (len(head) - 1), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _split(page: str, name: str, maker: str) -> tuple[str, str, str]:
    """Return what is before the text of a part, with the comment, the text, and what is behind."""
    start, end = f"<!-- {name}: made by {maker} -->", f"<!-- end of {name} -->"
    before, found, rest = page.partition(start)
    text, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"the page has no part for {name!r}")
    return before + start, text, end + after
