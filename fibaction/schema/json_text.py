"""`read_json`: the value of a JSON text of a stranger, in bounded time.

msgspec takes some 10 us for a number such as `1e308`, in one call that nothing interrupts: a text
of 1 MiB took 2 s, in which no thread of the process ran. Python's own parser takes less than 1 us
for each of them.
"""

from __future__ import annotations

import json
import math
import re
from itertools import islice
from typing import Any, NoReturn

import msgspec

MOST_COSTLY = 100
"""Numbers with an exponent of three digits or more that msgspec reads."""

_COSTLY = re.compile(r"[0-9.][eE][+-]?[0-9]{3}")
_COSTLY_BYTES = re.compile(_COSTLY.pattern.encode())


def has_costly_numbers(text: bytes | str) -> bool:
    """Return whether msgspec would take long for the numbers of a text."""
    found = _COSTLY.finditer(text) if isinstance(text, str) else _COSTLY_BYTES.finditer(text)
    return next(islice(found, MOST_COSTLY, None), None) is not None


def read_json(text: bytes | str) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: It is not JSON, or has a number that is too large for a float.
        RecursionError: It is nested too deeply.
    """
    if not has_costly_numbers(text):
        return msgspec.json.decode(text)
    text = text if isinstance(text, str) else text.decode()
    return json.loads(text, parse_float=_float, parse_constant=_reject)


def _float(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        _reject(text)
    return number


def _reject(text: str) -> NoReturn:
    raise ValueError(f"{text[:20]} is not a number of JSON, or is out of range")
