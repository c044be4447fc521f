"""The marked parts of docs/concepts.md: the statuses, and the tree of errors."""

from __future__ import annotations

import re
from collections.abc import Iterator

from page_parts import table
from states_picture import STORED

from fibaction.words import errors
from fibaction.words.errors import ActionError
from fibaction.words.statuses import TRANSITIONS, GoalEvent


def states_part() -> str:
    """Return the picture, and the table with the next status for each status and event."""
    picture = "The statuses of a goal and the events between them; the table says the same"
    columns = ["Status", *(event.name for event in GoalEvent)]
    rows: list[list[str]] = []
    for status in STORED:
        following = (TRANSITIONS.get((status, event)) for event in GoalEvent)
        cells = ("" if after is None else after.name for after in following)
        rows.append([f"{status.name}&nbsp;{status.value}", *cells])
    return f"![{picture}](states.svg)\n\n{table(columns, rows)}"


def errors_part() -> str:
    """Return the tree of errors, each with the first sentence of its docstring."""
    lines = list(_errors(ActionError, ""))
    width = max(len(name) for name, _ in lines)
    return "\n".join(("```text", *(f"{name:{width}}  {text}" for name, text in lines), "```"))


def _errors(error: type[ActionError], indent: str) -> Iterator[tuple[str, str]]:
    if not error.__name__.startswith("_"):
        text = re.split(r"[:;.](?:\s|$)", error.__doc__ or "", maxsplit=1)[0]
        yield indent + error.__name__, text
        indent += "  "
    for child in error.__subclasses__():
        if vars(errors).get(child.__name__) is child:
            yield from _errors(child, indent)
