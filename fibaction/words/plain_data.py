"""Plain data, which is what JSON, YAML and msgpack have in common: type guards, and quotations."""

from __future__ import annotations

import json
from collections.abc import Collection
from itertools import islice
from typing import Any, SupportsFloat, TypeGuard

import msgspec

from fibaction._runtime.text import printable

MAX_QUOTED = 60
"""Characters of a value that an error quotes."""

# Tuples, because a union is made again at each call, which takes longer than the test.
_LISTS = (list, tuple, set, frozenset)
_NUMBERS = (int, float)


def is_map(value: object) -> TypeGuard[dict[Any, Any]]:
    """Return whether the value is a map, with any keys and values."""
    return isinstance(value, dict)


def is_list(value: object) -> TypeGuard[Collection[Any]]:
    """Return whether the value is a list, or another collection that JSON writes as one."""
    return isinstance(value, _LISTS)


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether the value is a number in JSON, where true is not one."""
    return isinstance(value, _NUMBERS) and not isinstance(value, bool)


def check_is_number(name: str, value: object) -> None:
    """Raise TypeError for an argument that is not a number, such as the text of one."""
    if not isinstance(value, SupportsFloat):
        raise TypeError(f"{name} must be a number, not {value!r}")


def quoted(value: Any) -> str:
    """Return a value as JSON on one printable line, shortened to `MAX_QUOTED` characters.

    The work does not depend on the size of the value.
    """
    start = _start(value, [MAX_QUOTED + 1])
    try:
        text = msgspec.json.encode(start).decode()
    except (TypeError, ValueError):  # for example, text with a lone surrogate
        text = json.dumps(start, default=lambda other: f"<{type(other).__name__}>")
    text = printable(text)
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


def _start(value: Any, left: list[int]) -> Any:
    """Return as much of a value as its quotation can show. Each part of a value needs a character,
    so `left` counts the parts that are left.
    """
    left[0] -= 1
    if isinstance(value, str | bytes):
        return value[:MAX_QUOTED]
    if isinstance(value, int) and abs(value) >= 10**MAX_QUOTED:
        return f"{'-' if value < 0 else ''}1e{MAX_QUOTED} and more"
    if is_map(value):
        pairs = islice(value.items(), max(left[0], 0))
        return {str(_start(key, left)): _start(item, left) for key, item in pairs}
    if is_list(value):
        return [_start(item, left) for item in islice(value, max(left[0], 0))]
    return value
