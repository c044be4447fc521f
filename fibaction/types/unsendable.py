"""`unsendable`: the sentence about a whole number or a text that no message can hold."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from fibaction.words.plain_data import is_list, is_map

SMALLEST, LARGEST = -(2**63), 2**64 - 1


def unsendable(value: object, error: ArithmeticError | ValueError, root: str = "$") -> str:
    """Return the sentence about a value whose encoding has failed with an error of its numbers or
    texts; it names the place, from the `root` on.
    """
    what = "text with half a character, such as '\\ud800', cannot be sent: replace it"
    if isinstance(error, OverflowError):
        what = "a whole number of more than 64 bits cannot be sent: send it as text"
    from fibaction.types.ros_messages import plain

    try:
        path = _path(msgspec.to_builtins(value, enc_hook=plain))
    except (TypeError, ValueError, RecursionError):  # of a type that msgspec does not know
        path = None
    return what if path is None else f"{what} - at `{root}{path}`"


def _path(value: Any) -> str | None:
    """Return the path to the first part that cannot be sent; None if all can."""
    if isinstance(value, str):
        return None if _is_unicode(value) else ""
    if isinstance(value, int):
        return None if SMALLEST <= value <= LARGEST else ""
    parts: Iterable[tuple[str, Any]] = ()
    if is_map(value):
        if not all(isinstance(key, str) and _is_unicode(key) for key in value):
            return ""
        parts = ((f".{key}", one) for key, one in value.items())
    elif is_list(value):
        parts = ((f"[{at}]", one) for at, one in enumerate(value))
    found = ((step, _path(one)) for step, one in parts)
    return next((step + rest for step, rest in found if rest is not None), None)


def _is_unicode(text: str) -> bool:
    return text.isascii() or not any("\ud800" <= one <= "\udfff" for one in text)
