"""The parser of `.action` and `.msg` files.

A line means what it means to ROS's own parser, `rosidl_adapter/parser.py`: a `#` starts a comment
anywhere in a line, and a `=` makes a constant. A comment describes the field that it stands above,
behind, or (indented) below; a comment on top of a file describes the message. Defaults and
constants are read as ROS 2 reads them, but unbalanced quotes in arrays, `nan` and `inf` are errors.
"""

from __future__ import annotations

import math
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from fibaction.interfaces.definitions import (
    ConstantDefinition,
    FieldDefinition,
    FieldType,
    InterfaceError,
    MessageDefinition,
    SourceLine,
)
from fibaction.interfaces.ros_types import PRIMITIVES

_FIELD_NAME = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*", re.ASCII)
_CONSTANT_NAME = re.compile(r"[A-Z](_?[A-Z0-9])*", re.ASCII)
_FIELD_TYPE = re.compile(
    r"(?P<base>[A-Za-z0-9_/]+)(<=(?P<characters>[1-9][0-9]{,8}))?"
    r"(?P<array>\[((?P<most><=)?(?P<size>[1-9][0-9]{,8}))?\])?",
    re.ASCII,
)
_MESSAGE_TYPE = re.compile(r"((?P<package>[^/]+)/)?(?P<name>[A-Z][A-Za-z0-9]*)", re.ASCII)
_LONG_TYPE = re.compile(r"(?P<package>[^/]+)/msg/(?P<rest>[^/]+)", re.ASCII)

MOST_TEXT = 2**16
"""Characters of a file, which a robot may tell; those of ROS's own packages have a few thousand."""
MOST_MEMBERS = 1000
"""Fields of a message, and constants."""

_SEPARATOR = "---"
_ROS_1_TYPES = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
"""Types of ROS 1 that have another name in ROS 2."""


def parse_action(
    text: str, path: Path
) -> tuple[MessageDefinition, MessageDefinition, MessageDefinition]:
    """Parse the text of an `.action` file into goal, result and feedback, in this order.

    Raises:
        InterfaceError: The text is malformed.
    """
    goal, result, feedback = _parts(
        text,
        path,
        ("Goal", "Result", "Feedback"),
        f"two lines {_SEPARATOR!r}, between goal and result and between result and feedback",
    )
    return goal, result, feedback


def parse_service(text: str, path: Path) -> tuple[MessageDefinition, MessageDefinition]:
    """Parse the text of a `.srv` file into request and response.

    Raises:
        InterfaceError: The text is malformed.
    """
    wanted = f"one line {_SEPARATOR!r}, between request and response"
    request, response = _parts(text, path, ("Request", "Response"), wanted)
    return request, response


def _parts(text: str, path: Path, names: Sequence[str], wanted: str) -> Iterator[MessageDefinition]:
    lines = _lines(text, path)
    bars = [index for index, line in enumerate(lines) if line.text == _SEPARATOR]
    most = len(names) - 1
    if len(bars) != most:
        number = lines[bars[most]].number if len(bars) > most else max(len(lines), 1)
        raise InterfaceError(path, number, f"expected {wanted}, found {len(bars)}")
    starts = [0, *(bar + 1 for bar in bars)]
    for name, start, end in zip(names, starts, [*bars, len(lines)], strict=True):
        yield _message(lines[start:end], path, f"{path.stem}_{name}")


def parse_message(text: str, path: Path) -> MessageDefinition:
    """Parse the text of a `.msg` file.

    Raises:
        InterfaceError: The text is malformed.
    """
    return _message(_lines(text, path), path, path.stem)


def _lines(text: str, path: Path) -> list[SourceLine]:
    if len(text) > MOST_TEXT:
        raise InterfaceError(path, 1, f"expected at most {MOST_TEXT:,} characters, found more")
    lines = text.replace("\t", " ").splitlines()
    found = [SourceLine(path, number, line.rstrip()) for number, line in enumerate(lines, start=1)]
    for line, whole in zip(found, lines, strict=True):
        if line.text.lstrip() == _SEPARATOR != whole:
            raise line.error(f"a line {_SEPARATOR!r} without blanks", whole)
    return found


def _message(lines: Sequence[SourceLine], path: Path, name: str) -> MessageDefinition:
    first = next((i for i, line in enumerate(lines) if not line.text.startswith("#")), len(lines))
    about = [_comment(line.text) for line in lines[:first]]
    fields: list[FieldDefinition] = []
    constants: list[ConstantDefinition] = []
    for line, comments in _with_comments(lines[first:]):
        kind, _, rest = line.text.partition(" ")
        rest = rest.lstrip()
        if not rest:
            raise line.error("a type and a name, like 'int32 order'", line.text)
        if "=" in rest:
            constants.append(_constant(line, kind, rest, _joined(comments)))
        else:
            fields.append(_field(line, kind, rest, _joined(comments)))
    _check_members(path, fields)
    _check_members(path, constants)
    text = "".join(f"{line.text}\n" for line in lines)
    return MessageDefinition(path, name, tuple(fields), tuple(constants), _joined(about), text)


def _with_comments(lines: Iterable[SourceLine]) -> Iterator[tuple[SourceLine, list[str]]]:
    """Yield the lines that define something, without their comments, and the comments on each."""
    found: list[tuple[SourceLine, list[str]]] = []
    pending: list[str] = []
    for line in lines:
        text, hash_, _ = line.text.partition("#")
        comment = _comment(line.text[len(text) :])
        text = text.rstrip()
        if hash_ and not text and line.text.startswith(" "):
            if found:  # indented: it describes the field above
                found[-1][1].append(comment)
            continue
        if hash_:
            pending.append(comment)
        if text:
            found.append((line._replace(text=text), pending))
            pending = []
    yield from found


def _comment(text: str) -> str:
    # Comments become Python source, which cannot hold control characters.
    return "".join(sign if sign.isprintable() else " " for sign in text.lstrip("#"))


def _joined(comments: Iterable[str]) -> str:
    return textwrap.dedent("\n".join(comment.rstrip() for comment in comments)).strip("\n")


def _check_members(path: Path, members: Iterable[FieldDefinition | ConstantDefinition]) -> None:
    lines: dict[str, int] = {}
    for member in members:
        if len(lines) == MOST_MEMBERS:
            problem = f"expected at most {MOST_MEMBERS:,} fields or constants, found more"
            raise InterfaceError(path, member.line, problem)
        if member.name in lines:
            raise InterfaceError(
                path,
                member.line,
                f"expected a unique name, found {member.name!r}, which line"
                f" {lines[member.name]} defines",
            )
        lines[member.name] = member.line


def _field(line: SourceLine, kind: str, rest: str, comment: str) -> FieldDefinition:
    field_type = _field_type(line, kind)
    name, _, given = rest.partition(" ")
    given = given.strip()
    if not _FIELD_NAME.fullmatch(name):
        raise line.error("a field's name, like 'frame_id' (lower case, no '__')", name)
    default = None
    if given and field_type.is_message:
        raise line.error("no default, because messages have their own", given)
    if given:
        default = read_value(line, field_type, given)
    return FieldDefinition(line.number, field_type, name, default, comment)


def _constant(line: SourceLine, kind: str, rest: str, comment: str) -> ConstantDefinition:
    name, _, given = rest.partition("=")
    name, given = name.rstrip(), given.lstrip()
    if not _CONSTANT_NAME.fullmatch(name):
        raise line.error("a constant's name, like 'MAX_SPEED', before the '='", name)
    if kind not in PRIMITIVES:
        raise line.error("a constant's type, like 'int32' or 'string'", kind)
    value = read_single(line, FieldType(kind), given)
    return ConstantDefinition(line.number, kind, name, value, comment)


def _field_type(line: SourceLine, text: str) -> FieldType:
    expected = "a type like 'int32', 'string<=10', 'float64[3]' or 'geometry_msgs/Pose'"
    parts = _FIELD_TYPE.fullmatch(text)
    if parts is None:
        raise line.error(expected, text)
    base, package = parts["base"], ""
    if base in _ROS_1_TYPES:
        raise line.error(repr(_ROS_1_TYPES[base]), text)
    if base not in PRIMITIVES:
        message = _MESSAGE_TYPE.fullmatch(base)
        long = _LONG_TYPE.fullmatch(text)
        if long:
            raise line.error(f"'{long['package']}/{long['rest']}', without 'msg'", text)
        if message is None or not _FIELD_NAME.fullmatch(message["package"] or "none"):
            raise line.error(expected, text)
        base, package = message["name"], message["package"] or ""
    characters = _count(parts["characters"])
    if characters is not None and base not in STRINGS:
        raise line.error("'<=' behind a string only, or within '[]'", text)
    size, bounded = _count(parts["size"]), parts["most"] is not None
    return FieldType(
        base,
        package,
        characters,
        parts["array"] is not None,
        None if bounded else size,
        size if bounded else None,
    )


def _count(digits: str | None) -> int | None:
    return None if digits is None else int(digits)


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
