"""The values of defaults and constants, read as ROS 2 reads them.

Stricter than ROS in two cases: unbalanced quotes in arrays, and `nan` and `inf`, are errors.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from fibaction.interfaces.definitions import FieldType, SourceLine

T = TypeVar("T")

STRINGS = ("string", "wstring")
_QUOTES = ('"', "'")
_OCTETS = ("byte", "char", "uint8")
_BOOLS = {"true": True, "1": True, "false": False, "0": False}
_ESCAPE = re.compile(
    r"\\(?:([0-7]{1,3})|x([0-9a-fA-F]{2})|u([0-9a-fA-F]{4})|U([0-9a-fA-F]{8})|([abfnrtv\\'\"]))"
)
_QUOTED = re.compile(r"""(["'])(?:\\.|(?!\1)[^\\])*\1""")
_SIGNS = dict(zip("abfnrtv\\'\"", "\a\b\f\n\r\t\v\\'\"", strict=True))


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
        # ROS reads it twice: on the way to IDL and back. There, '\\\\' is a backslash once more.
        value = _unescaped(_unescaped(_unquoted(line, text)))
        return _checked(line, kind, re.sub(r"\\([\\\"])", r"\1", value))
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
    closing = {quote: _ClosingQuotes(text, quote) for quote in _QUOTES}
    whole = len(text)
    while text := text.lstrip(" "):
        if text[0] == ",":
            raise line.error('strings like \'["one", "two"]\'', text)
        if text[0] in _QUOTES:
            end = closing[text[0]].of(whole - len(text))
            if end is None and (quoted := _QUOTED.match(text)):
                end = quoted.end() - 1
            if end is None:
                raise line.error('strings like \'["one", "two"]\'', text)
            value, text = text[1:end].replace(f"\\{text[0]}", text[0]), text[end + 1 :]
        else:
            value = text.partition(",")[0]
            text = text[len(value) :]
        value = _unquoted(line, value.strip())  # ROS, too, strips and unquotes once more
        yield _checked(line, kind, _unescaped(value))
        text = text.lstrip(" ").removeprefix(",")


class _ClosingQuotes:
    """The ends of the strings in a text that one quote begins, as ROS sees them.

    After an escaped quote, ROS skips a character, and after a second one it counts from there.
    Such strings are not what their author meant, but they are the defaults that ROS builds. What it
    cannot build is read as it was meant.
    """

    def __init__(self, text: str, quote: str) -> None:
        self._text = text
        self._quote = quote
        self._known: dict[int, tuple[int | None, bool]] = {}
        """The ends by the starts of a search, and whether there is an escaped quote before the end:
        so each quote is looked at once, however many strings there are."""

    def of(self, start: int) -> int | None:
        """Return the end of the string at a place, counted from there; None if ROS sees none."""
        passed: list[int] = []
        at = start
        while at not in self._known:
            quote = self._text.find(self._quote, at + 1)
            if quote < 0:
                self._known[at] = None, True
            elif self._text[quote - 1] != "\\":
                self._known[at] = quote - at, False
            else:
                passed.append(at)
                at = quote + 1
        for before in reversed(passed):
            end, is_counted = self._known[at]
            self._known[before] = end if end is None or is_counted else at - before + end, True
            at = before
        return self._known[start][0]


def _unescaped(text: str) -> str:
    """Return a text with each escape sequence as the character that it stands for."""
    return _ESCAPE.sub(_sign, text)


def _sign(escape: re.Match[str]) -> str:
    octal, *hexadecimal, letter = escape.groups()
    if letter:
        return _SIGNS[letter]
    number = int(octal, 8) if octal else int(next(filter(None, hexadecimal)), 16)
    return chr(number) if number <= sys.maxunicode else escape[0]


def _checked(line: SourceLine, kind: FieldType, value: str) -> str:
    if kind.characters is not None and len(value) > kind.characters:
        raise line.error(f"a string of at most {kind.characters} characters", value)
    return value


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
    for quote in _QUOTES:
        if text.startswith(quote) and text.endswith(quote):
            inner = text[1:-1]
            if re.search(rf"(?<!\\){quote}", inner):
                raise line.error(rf"\{quote} for a quote within a string", text)
            return inner.replace(f"\\{quote}", quote)
    return text
