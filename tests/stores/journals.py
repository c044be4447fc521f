"""Files of goals, as a journal writes them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from fibaction.stores._journal_file import JournalFile
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.testing.contract.stores import a_goal

SIZE = 3000
"""Bytes of the result of each goal: with the goals of 20 commits there are pages of all kinds."""


def add(file: JournalFile, number: int, action: str = "paint") -> None:
    """Add a goal, in a commit of its own."""
    goal = a_goal(number, result=bytes([number]) * SIZE)
    file.add(encode_row(file.next_number, [WholeRecord(action, goal)]))


def stamps(path: Path) -> list[int]:
    """Return the stamps of the goals in a file."""
    with closing(JournalFile(str(path), "full")) as file:
        return [goal.stamp for goal in file.goals().of("paint").in_order()]
