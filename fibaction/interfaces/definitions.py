"""What an interface file says, line by line, and how it is told that a line is wrong.

Knows neither the grammar nor the types of Python.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from fibaction.ros_types import PRIMITIVES


class InterfaceError(ValueError):
    """A `.action` or `.msg` file that ROS could not read either, or that names what is not there.

    The text names the file, the line, and what was expected.
    """

    def __init__(self, path: Path, line: int, problem: str) -> None:
        super().__init__(f"{path}:{line}: {problem}")
        self.path = path
        self.line = line
        """The number of the line; the first is 1."""
        self.problem = problem
        """The text without file and line."""


class FieldType(NamedTuple):
    """The type of a field: `string<=5[<=3]`."""

    base: str
    """A name in `fibaction.ros_types.PRIMITIVES`, or that of a message, without the package."""
    package: str = ""
    """The package of a message; empty where that of the file is meant."""
    characters: int | None = None
    """The greatest length of a string."""
    is_array: bool = False
    size: int | None = None
    """How many elements an array has; None if that varies."""
    bound: int | None = None
    """How many elements it has at most."""

    @property
    def is_message(self) -> bool:
        return self.base not in PRIMITIVES


class Field(NamedTuple):
    """A field of a message."""

    line: int
    type: FieldType
    name: str
    default: Any
    """In plain data, `bytes` for arrays of bytes; None if the file gives none."""
    comment: str


class Constant(NamedTuple):
    """A constant of a message."""

    line: int
    type: str
    name: str
    value: Any
    comment: str


class Definition(NamedTuple):
    """A message as its file has it; an action has three."""

    path: Path
    name: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...]
    comment: str


class Line(NamedTuple):
    """A line of a file, and where it is."""

    path: Path
    number: int
    text: str

    def expected(self, what: str, found: str) -> InterfaceError:
        """The error that tells what should be in this line."""
        return InterfaceError(self.path, self.number, f"expected {what}, found {found!r}")
