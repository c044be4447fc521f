"""The parameters of a node: their values in messages, and those that the node itself has."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeAlias

from msgspec import Struct

from fibaction.words.errors import text_of

ParameterValue: TypeAlias = (
    bool | int | float | str | bytes | list[bool] | list[int] | list[float] | list[str] | None
)
"""The value of a parameter; None if it is not set."""

BYTES: Final = 5
# rcl_interfaces/msg/ParameterType.msg
KINDS: Final = (
    "not_set",
    "bool",
    "integer",
    "double",
    "string",
    "byte_array",
    "bool_array",
    "integer_array",
    "double_array",
    "string_array",
)
"""The types of parameters, by their numbers."""
_TYPES: Final[dict[type, int]] = {bool: 1, int: 2, float: 3, str: 4}
ARRAY: Final = BYTES
"""The difference between the number of a type and that of its arrays."""
_INTEGERS: Final = (-(2**63), 2**63 - 1)
_DOUBLES: Final = (-sys.float_info.max, sys.float_info.max)


def kind_of(number: int) -> str:
    """Return the type of a number with its article, for errors: `an integer`."""
    kind = KINDS[number]
    return f"{'an' if kind.startswith('i') else 'a'} {kind}"


def value_of(value: Any) -> ParameterValue:
    """Return the value in an `rcl_interfaces/msg/ParameterValue`."""
    if not 0 < value.type < len(KINDS):
        return None
    found: Any = getattr(value, f"{KINDS[value.type]}_value")
    if value.type == BYTES:
        return bytes(found) if isinstance(found, bytes) else b"".join(found)
    # Arrays of numbers are those of Python or of numpy.
    plain: ParameterValue = found.tolist() if hasattr(found, "tolist") else found
    return plain


def number_of(value: ParameterValue) -> int:
    """Return the number of the type of a value; an empty list counts as one of strings.

    Raises:
        TypeError: Parameters cannot have it.
    """
    if value is None:
        return 0
    if isinstance(value, bytes):
        return BYTES
    number = _TYPES.get(type(value))
    if isinstance(value, list):
        items = {type(one) for one in value} or {str}
        item = _TYPES.get(items.pop()) if len(items) == 1 else None
        number = item and item + ARRAY
    if number is None:
        raise TypeError(
            f"{value!r} cannot be a parameter: these are bool, int, float, str, bytes, and lists"
            " of one of the first four"
        )
    return number


def written(value: ParameterValue) -> dict[str, Any]:
    """Return a value as the fields of an `rcl_interfaces/msg/ParameterValue`.

    Raises:
        TypeError: Parameters cannot have it.
    """
    number = number_of(value)
    return {"type": number} | ({f"{KINDS[number]}_value": value} if number else {})


class DeclaredParameter(Struct, frozen=True, kw_only=True):
    """A parameter that a node has, and the values that it may have."""

    name: str
    default: ParameterValue
    description: str = ""
    low: float | None = None
    high: float | None = None
    is_read_only: bool = False
    """True if only the arguments and the files of parameters change it."""
    check: Callable[[Any], object] | None = None
    """Raises `ValueError` with the reason why a value is refused."""

    def problem(self, value: ParameterValue) -> str:
        """Return the reason why a value is refused; empty if it is not."""
        number = number_of(self.default)
        if number_of(value) != number and not (value == [] and number > ARRAY):
            return f"{self.name!r} is {kind_of(number)}"
        numbers: Any = value if isinstance(value, list) else [value]
        low, high = self.bounds or (0, 0)
        if self.bounds and not all(low <= one <= high for one in numbers):
            ends = ("at least", self.low), ("at most", self.high)
            allowed = " and ".join(f"{word} {end:g}" for word, end in ends if end is not None)
            return f"{self.name!r} is {allowed}, and not {value!r}"
        return self.checked(value)

    @property
    def bounds(self) -> tuple[float, float] | None:
        """The least and the largest value; None if all values are allowed.

        Raises:
            TypeError: There are bounds, and the values are not numbers.
        """
        if self.low is None and self.high is None:
            return None
        kind = KINDS[number_of(self.default)]
        if not kind.startswith(("integer", "double")):
            raise TypeError(f"{self.name!r} is a {kind}: low and high are for numbers")
        ends = _INTEGERS if kind.startswith("integer") else _DOUBLES
        low, high = (
            end if one is None else type(end)(one)
            for one, end in zip((self.low, self.high), ends, strict=True)
        )
        return low, high

    def checked(self, value: Any) -> str:
        """Return the reason why the user's function refuses a value; empty if it does not."""
        try:
            if self.check is not None:
                self.check(value)
        except ValueError as exc:
            return str(exc) or text_of(exc)
        except Exception as exc:  # the function is the user's
            return text_of(exc)
        return ""


class ParameterStore(ABC):
    """The parameters that a node itself has, and serves to others."""

    def __init__(self) -> None:
        self._takers: list[Callable[[Mapping[str, ParameterValue]], None]] = []

    def on_change(self, take: Callable[[Mapping[str, ParameterValue]], None]) -> Callable[[], None]:
        """Call `take` with what was set. The function that is returned takes it back."""
        self._takers.append(take)
        return lambda: self._takers.remove(take)

    def tell(self, changed: Mapping[str, ParameterValue]) -> None:
        """Call all that wait for changes."""
        for take in [*self._takers]:
            take(changed)

    @abstractmethod
    def declare(self, parameter: DeclaredParameter) -> None:
        """Add a parameter, with its default or the value that the arguments of the node have.

        Raises:
            ValueError: There is one of this name, or a value is refused.
            TypeError: The default is of a type that parameters cannot have.
        """

    @abstractmethod
    def names(self) -> Sequence[str]:
        """Return the names of all parameters."""

    @abstractmethod
    def value(self, name: str) -> ParameterValue:
        """Return the value of a parameter; None if there is none of this name."""

    @abstractmethod
    def set_values(self, values: Mapping[str, ParameterValue]) -> None:
        """Set parameters, all of them or none.

        Raises:
            ValueError: A value is refused; the text has the reason.
            TypeError: A value is of a type that parameters cannot have.
        """
