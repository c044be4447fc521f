"""The values that an executor yields: `Progress`, the rule for other feedback, and `Return`.

Sans-I/O. The command line, `top`, MCP and `track` ask a `ProgressMeter`; the console has the same
rule in `schema.js`.
"""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

import msgspec

from fibaction.words.plain_data import is_map, is_number

COUNTS = ("done", "completed", "current", "progress")
"""Names of fields for what is done, next to a field `total`."""
PERCENT = ("percent", "percentage", "percent_complete", "percentage_complete", "percent_done")
FRACTION = ("fraction", "fraction_complete", "fraction_done", "ratio", "completion", "progress")
"""Names of fields for the progress of a goal, from 0 to 100 and from 0 to 1. A field of the second
kind counts to 100 as soon as it is larger than 1, since `progress` is used both ways."""

_FIELDS = ("__struct_fields__", "__dataclass_fields__", "model_fields")
"""The attributes by which msgspec, dataclasses and pydantic name the fields of a class."""


class Progress(msgspec.Struct, frozen=True):
    """Feedback that every display draws as a progress bar.

    For example:

        @action
        async def copy(report: Report[Progress], files: list[str]) -> int:
            for number, name in enumerate(files):
                await report(Progress(number, len(files), name))
            return len(files)
    """

    done: float
    """The part that is done."""
    total: float | None = None
    """The whole; None if it is not known."""
    text: str = ""
    """The current work, for people."""

    @property
    def fraction(self) -> float | None:
        """The part of the total that is done, from 0 to 1; None if it is not known."""
        if self.total is None or not (math.isfinite(self.total) and self.total > 0):
            return None
        return None if math.isnan(self.done) else min(max(self.done / self.total, 0.0), 1.0)

    @property
    def label(self) -> str:
        """The counts and the text on one line, for example `3/10 unpacking`."""
        total = "" if self.total is None else f"/{self.total:g}"
        return f"{self.done:g}{total} {self.text}".rstrip()


class ProgressMeter:
    """A reader of the progress of one goal in its feedback, of any type.

    Feedback tells the progress if it is a `Progress`, or has its fields: a number `done`,
    `completed`, `current` or `progress` with a number `total`, and perhaps a `text`; or if it has a
    field for percent or for a fraction.
    """

    def __init__(self) -> None:
        self.fields: tuple[str, ...] = ()
        """The fields of the last feedback that have told it; empty if none have."""
        self._of_hundred = False

    def read(self, feedback: Any) -> Progress | None:
        """Return the progress; None if the feedback does not tell."""
        self.fields = ()
        values = _values_of(feedback)
        return (self._count(values) or self._part(values)) if values else None

    def _count(self, values: dict[Any, Any]) -> Progress | None:
        total, text = values.get("total"), values.get("text")
        is_progress = total is None and values.keys() == {"done", "total", "text"}
        if not (is_number(total) or is_progress):
            return None
        if total is not None and not math.isfinite(total):
            total = None
        for name in COUNTS:
            if is_number(done := values.get(name)) and math.isfinite(done):
                self.fields = (name, "total")
                return Progress(done, total, text if isinstance(text, str) else "")
        return None

    def _part(self, values: dict[Any, Any]) -> Progress | None:
        for name, value in values.items():
            if not is_number(value) or not math.isfinite(value):
                continue
            if name in PERCENT:
                self.fields = (name,)
                return Progress(value, 100)
            if name in FRACTION:
                self.fields = (name,)
                self._of_hundred = self._of_hundred or value > 1
                return Progress(value, 100 if self._of_hundred else 1)
        return None


def _values_of(feedback: object) -> dict[Any, Any] | None:
    """Return the values of a map or of an object with fields, by their names."""
    if is_map(feedback):
        return feedback
    for attribute in _FIELDS:
        if names := getattr(type(feedback), attribute, None):
            return {name: getattr(feedback, name) for name in names}
    return None


T_co = TypeVar("T_co", covariant=True)


class Return(Generic[T_co]):
    """The result of a goal, as an async generator yields it, whatever the type of its feedback.

    Python has no `return` with a value in an async generator: it is a SyntaxError. A generator
    yields its result last. If feedback and result have one type, it marks the result:

        async def count(goal: GoalHandle[int]) -> AsyncIterator[int | Return[int]]:
            for number in range(goal.request):
                yield number
            yield Return(goal.request)

    Clients get the value alone.
    """

    __slots__ = ("value",)

    def __init__(self, value: T_co) -> None:
        self.value = value
        """The result."""

    def __repr__(self) -> str:
        return f"Return({self.value!r})"
