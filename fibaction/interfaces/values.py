"""The values of defaults and constants, read as ROS 2 reads them.

Stricter than ROS in two cases: unbalanced quotes in arrays, and `nan` and `inf`, are errors.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from fibaction.interfaces.definitions import FieldType, SourceLine

T = TypeVar("T")

STRINGS = ("string", "wstring")
_OCTETS = ("byte", "char", "uint8")
_BOOLS = {"true": True, "1": True, "false": False, "0": False}
_STRING = re.compile(r""" *(?:"((?:\\"|[^"])*)"|'((?:\\'|[^'])*)'|([^, "'][^,]*)) *(?:,|$)""")


def read_value(line: SourceLine, kind: FieldType, text: str) -> Any:
    """Read a default as plain data; an array of bytes as `bytes`.

    Raises:
        InterfaceError: The text is not a value of this type.
    """
    if not kind.is_array:
        return read_single(line, kind, text)
    if not (text.startswith("[") and text.endswith("]")):
        raise line.error("an array like '[1, 2]'", text)
    inner = text[1:-1]
    values: list[Any]
    if kind.base in STRINGS:
        values = list(_strings(line, kind, inner))
    else:
        values = [read_single(line, kind, one.strip()) for one in inner.split(",")] if inner else []
    if kind.size is not None and len(values) != kind.size:
        raise line.error(f"{kind.size} elements", text)
    if kind.bound is not None and len(values) > kind.bound:
        raise line.error(f"at most {kind.bound} elements", text)
    return bytes(values) if kind.base in _OCTETS else values


def read_single(line: SourceLine, kind: FieldType, text: str) -> Any:
    """Read a single value; `kind` may be the type of its array.

    Raises:
        InterfaceError: The text is not a value of this type.
    """
    if kind.base in STRINGS:
        value = _unquoted(line, text)
        if kind.characters is not None and len(value) > kind.characters:
            raise line.error(f"a string of at most {kind.characters} characters", value)
        return value
    if kind.base == "bool":
        if text.lower() not in _BOOLS:
            raise line.error("'true' or 'false'", text)
        return _BOOLS[text.lower()]
    if kind.base.startswith("float"):
        number = _number(float, text)
        if number is None or not math.isfinite(number):
            raise line.error(f"a {kind.base}, like '1.5'", text)
        return number
    return _integer(line, kind, text)


def _strings(line: SourceLine, kind: FieldType, text: str) -> Iterator[str]:
    start = 0
    while text[start:].strip():
        found = _STRING.match(text, start)
        if found is None:
            raise line.error('strings like \'["one", "two"]\'', text[start:])
        double, single, bare = found.groups()
        if double is not None:
            value = double.replace('\\"', '"')
        elif single is not None:
            value = single.replace("\\'", "'")
        else:
            value = bare
        yield read_single(line, kind, value.strip())  # ROS, too, strips and unquotes once more
        start = found.end()


def _integer(line: SourceLine, kind: FieldType, text: str) -> int:
    low, high = _limits(kind.base)
    value = _number(int, text)
    if value is None:
        value = _number(lambda digits: int(digits, 0), text)  # 0x1F
    if value is None or not low <= value <= high:
        raise line.error(f"{kind.base} from {low} to {high}", text)
    return value


def _limits(base: str) -> tuple[int, int]:
    if base in _OCTETS:
        return 0, 2**8 - 1
    if base.startswith("uint"):
        return 0, 2 ** int(base.removeprefix("uint")) - 1
    half: int = 2 ** (int(base.removeprefix("int")) - 1)
    return -half, half - 1


def _number(convert: Callable[[str], T], text: str) -> T | None:
    try:
        return convert(text)
    except ValueError:
        return None


def _unquoted(line: SourceLine, text: str) -> str:
    for quote in ('"', "'"):
        if text.startswith(quote) and text.endswith(quote):
            inner = text[1:-1]
            if re.search(rf"(?<!\\){quote}", inner):
                raise line.error(rf"\{quote} for a quote within a string", text)
            return inner.replace(f"\\{quote}", quote)
    return text
