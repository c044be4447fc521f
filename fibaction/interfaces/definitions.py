"""Parsed interface files, and the error for a malformed line."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from fibaction.interfaces.ros_types import PRIMITIVES


class InterfaceError(ValueError):
    """An error in a `.action` or `.msg` file, or in the search for a nested message.

    The text names the file, the line, and what was expected there.
    """

    def __init__(self, path: Path, line: int, problem: str) -> None:
        super().__init__(f"{path}:{line}: {problem}")
        self.path = path
        self.line = line
        """The number of the line; the first is 1."""
        self.problem = problem
        """The text without file and line."""


class FieldType(NamedTuple):
    """The type of a field, for example `string<=5[<=3]`."""

    base: str
    """A name in `fibaction.interfaces.ros_types.PRIMITIVES`, or that of a message, without the
    package."""
    package: str = ""
    """The package of a message; empty for the package of the file."""
    characters: int | None = None
    """The maximum length of a string."""
    is_array: bool = False
    size: int | None = None
    """The number of elements of an array; None if it varies."""
    bound: int | None = None
    """The maximum number of elements."""

    @property
    def is_message(self) -> bool:
        return self.base not in PRIMITIVES


class FieldDefinition(NamedTuple):
    """A field of a message."""

    line: int
    type: FieldType
    name: str
    default: Any
    """Plain data, `bytes` for arrays of bytes; None if the file gives no default."""
    comment: str


class ConstantDefinition(NamedTuple):
    """A constant of a message."""

    line: int
    type: str
    name: str
    value: Any
    comment: str


class MessageDefinition(NamedTuple):
    """A message as its file defines it; an action consists of three."""

    path: Path
    name: str
    fields: tuple[FieldDefinition, ...]
    constants: tuple[ConstantDefinition, ...]
    comment: str
    text: str = ""
    """The lines of its definition, with their comments."""


class SourceLine(NamedTuple):
    """A line of a file, with its position."""

    path: Path
    number: int
    text: str

    def error(self, expected: str, found: str) -> InterfaceError:
        """Return the error for a line that holds something else than expected."""
        return InterfaceError(self.path, self.number, f"expected {expected}, found {found!r}")
