"""`CdrError`: the error for a payload that is malformed, and for a value that does not fit."""

from __future__ import annotations

from fibaction.border.peer_text import excerpt
from fibaction.words.errors import ProtocolError


class CdrError(ProtocolError, ValueError):
    """A payload that cannot be read, or a value that cannot be written, as a message of ROS.

    The text names the type, the field and what is wrong there, for example
    "geometry_msgs/msg/Polygon.points[3].x: 4 bytes expected, 2 bytes left".
    """

    def __init__(self, problem: str, *, field: str = "", type_name: str = "") -> None:
        super().__init__(problem)
        self.problem = problem
        """The cause, without its place."""
        self.field = field
        """The path to the field, for example `points[3].x`; empty for the message as a whole."""
        self.type_name = type_name
        """The type of the whole message."""

    def __str__(self) -> str:
        place = f"{self.type_name}.{self.field}" if self.field else self.type_name
        return excerpt(f"{place}: {self.problem}" if place else self.problem)

    def put_under(self, step: str) -> None:
        """Put a step before the path: the name of a field, `[index]`, or nothing."""
        dot = "." if step and self.field and not self.field.startswith("[") else ""
        self.field = f"{step}{dot}{self.field}"
