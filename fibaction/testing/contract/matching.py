"""What is compared of a value, so that a field that it has in addition breaks no test."""

from __future__ import annotations

from typing import Any

import msgspec

from fibaction import GoalStatus, Outcome


class End:
    """Equal to an outcome of this status, result and reason, whatever else it tells."""

    __hash__ = None  # type: ignore[assignment]  # it is equal to outcomes that differ

    def __init__(self, status: GoalStatus, result: Any = None, reason: str = "") -> None:
        self._told = (status, result, reason)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Outcome) and self._told == (
            other.status,
            other.result,
            other.reason,
        )

    def __repr__(self) -> str:
        return f"End{self._told!r}"


class Like:
    """Equal to a struct of the same type that has the same in all fields that `wanted` is given:
    those without a default, and those that are not the default.
    """

    __hash__ = None  # type: ignore[assignment]  # it is equal to structs that differ

    def __init__(self, wanted: msgspec.Struct) -> None:
        self._type = type(wanted)
        self._told = {
            field.name: getattr(wanted, field.name)
            for field in msgspec.structs.fields(wanted)
            if field.required or getattr(wanted, field.name) != field.default
        }

    def __eq__(self, other: object) -> bool:
        return isinstance(other, self._type) and all(
            getattr(other, name) == value for name, value in self._told.items()
        )

    def __repr__(self) -> str:
        return f"Like({self._type.__name__}, {self._told!r})"
