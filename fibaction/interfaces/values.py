"""The values of defaults and constants, read as ROS 2 reads them.

But that quotes which do not match are refused in arrays, where ROS makes something of them, and so
are `nan` and `inf`, with which ROS makes code that does not work.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from fibaction.interfaces.definitions import FieldType, Line

T = TypeVar("T")

STRINGS = ("string", "wstring")
_OCTETS = ("byte", "char", "uint8")
_BOOLS = {"true": True, "1": True, "false": False, "0": False}


def read_value(line: Line, kind: FieldType, text: str) -> Any:
    """A default, in plain data; `bytes` for an array of bytes.

    Raises:
        InterfaceError: It is no value of this type.
    """
    if not kind.is_array:
        return read_single(line, kind, text)
    if not (text.startswith("[") and text.endswith("]")):
        raise line.expected("an array like '[1, 2]'", text)
    inner = text[1:-1]
    values: list[Any]
    if kind.base in STRINGS:
        values = list(_strings(line, kind, inner))
    else:
        values = [read_single(line, kind, one.strip()) for one in inner.split(",")] if inner else []
    if kind.size is not None and len(values) != kind.size:
        raise line.expected(f"{kind.size} elements", text)
    if kind.bound is not None and len(values) > kind.bound:
        raise line.expected(f"at most {kind.bound} elements", text)
    return bytes(values) if kind.base in _OCTETS else values


_STRING = re.compile(r""" *(?:"((?:\\"|[^"])*)"|'((?:\\'|[^'])*)'|([^, "'][^,]*)) *(?:,|$)""")


def _strings(line: Line, kind: FieldType, text: str) -> Iterator[str]:
    start = 0
    while text[start:].strip():
        found = _STRING.match(text, start)
        if found is None:
            raise line.expected('strings like \'["one", "two"]\'', text[start:])
        double, single, bare = found.groups()
        if double is not None:
            value = double.replace('\\"', '"')
        elif single is not None:
            value = single.replace("\\'", "'")
        else:
            value = bare
        yield read_single(line, kind, value.strip())  # strip, and unquote once more, as ROS does
        start = found.end()


def read_single(line: Line, kind: FieldType, text: str) -> Any:
    """A single value; `kind` may be that of the array that it is in.

    Raises:
        InterfaceError: It is no value of this type.
    """
    if kind.base in STRINGS:
        return _short_enough(line, kind, _unquoted(line, text))
    if kind.base == "bool":
        if text.lower() not in _BOOLS:
            raise line.expected("'true' or 'false'", text)
        return _BOOLS[text.lower()]
    if kind.base.startswith("float"):
        value = _read(float, text)
        if value is None or not math.isfinite(value):
            raise line.expected(f"a {kind.base}, like '1.5'", text)
        return value
    least, most = _limits(kind.base)
    value = _read(int, text)
    if value is None:
        value = _read(lambda digits: int(digits, 0), text)  # 0x1F
    if value is None or not least <= value <= most:
        raise line.expected(f"{kind.base} from {least} to {most}", text)
    return value


def _limits(base: str) -> tuple[int, int]:
    if base in _OCTETS:
        return 0, 2**8 - 1
    if base.startswith("uint"):
        return 0, 2 ** int(base.removeprefix("uint")) - 1
    half: int = 2 ** (int(base.removeprefix("int")) - 1)
    return -half, half - 1


def _read(number: Callable[[str], T], text: str) -> T | None:
    try:
        return number(text)
    except ValueError:
        return None


def _unquoted(line: Line, text: str) -> str:
    for quote in ('"', "'"):
        if text.startswith(quote) and text.endswith(quote):
            inner = text[1:-1]
            if re.search(rf"(?<!\\){quote}", inner):
                raise line.expected(rf"\{quote} for a quote within a string", text)
            return inner.replace(f"\\{quote}", quote)
    return text


def _short_enough(line: Line, kind: FieldType, text: str) -> str:
    if kind.characters is not None and len(text) > kind.characters:
        raise line.expected(f"a string of at most {kind.characters} characters", text)
    return text
