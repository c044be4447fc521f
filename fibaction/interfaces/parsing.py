"""The text of `.action` and `.msg` files, as ROS 2 reads it.

The format is one of lines, and what a line means is what ROS's own `rosidl_adapter/parser.py` takes
it for: so a `#` starts a comment wherever it is, and a `=` makes a constant. Comments describe the
field that they stand above, behind, or (indented) below; those on top, the message. Knows nothing
of where files lie.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from fibaction.interfaces.definitions import (
    Constant,
    Definition,
    Field,
    FieldType,
    InterfaceError,
    Line,
)
from fibaction.interfaces.values import STRINGS, read_single, read_value
from fibaction.ros_types import PRIMITIVES

_NAME = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*", re.ASCII)
_CONSTANT = re.compile(r"[A-Z](_?[A-Z0-9])*", re.ASCII)
_TYPE = re.compile(
    r"(?P<base>[A-Za-z0-9_/]+)(<=(?P<characters>[1-9][0-9]{,8}))?"
    r"(?P<array>\[((?P<most><=)?(?P<size>[1-9][0-9]{,8}))?\])?",
    re.ASCII,
)
_MESSAGE = re.compile(r"((?P<package>[^/]+)/)?(?P<name>[A-Z][A-Za-z0-9]*)", re.ASCII)

_SEPARATOR = "---"
# What ROS 1 had for them.
_OLD_NAMES = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}


def parse_action(text: str, path: Path) -> tuple[Definition, Definition, Definition]:
    """The goal, the result and the feedback in the text of an `.action` file, in this order.

    Raises:
        InterfaceError: It is malformed.
    """
    lines = _lines(text, path)
    bars = [index for index, line in enumerate(lines) if line.text.rstrip() == _SEPARATOR]
    if len(bars) != 2:
        number = lines[bars[2]].number if len(bars) > 2 else max(len(lines), 1)
        raise InterfaceError(
            path,
            number,
            f"expected two lines {_SEPARATOR!r}, between goal and result and between result and"
            f" feedback, found {len(bars)}",
        )
    first, second = bars
    return (
        _message(lines[:first], path, f"{path.stem}_Goal"),
        _message(lines[first + 1 : second], path, f"{path.stem}_Result"),
        _message(lines[second + 1 :], path, f"{path.stem}_Feedback"),
    )


def parse_message(text: str, path: Path) -> Definition:
    """What is in the text of a `.msg` file.

    Raises:
        InterfaceError: It is malformed.
    """
    return _message(_lines(text, path), path, path.stem)


def _lines(text: str, path: Path) -> list[Line]:
    lines = text.replace("\t", " ").splitlines()
    return [Line(path, number, line.rstrip()) for number, line in enumerate(lines, start=1)]


def _message(lines: Sequence[Line], path: Path, name: str) -> Definition:
    first = next((i for i, line in enumerate(lines) if not line.text.startswith("#")), len(lines))
    about = [_comment(line.text) for line in lines[:first]]
    fields: list[Field] = []
    constants: list[Constant] = []
    for line, comments in _described(lines[first:]):
        kind, _, rest = line.text.partition(" ")
        rest = rest.lstrip()
        if not rest:
            raise line.expected("a type and a name, like 'int32 order'", line.text)
        if "=" in rest:
            constants.append(_constant(line, kind, rest, _joined(comments)))
        else:
            fields.append(_field(line, kind, rest, _joined(comments)))
    _check_unique(path, fields)
    _check_unique(path, constants)
    return Definition(path, name, tuple(fields), tuple(constants), _joined(about))


def _described(lines: Iterable[Line]) -> Iterator[tuple[Line, list[str]]]:
    """The lines that say something, without their comments, and the comments on each."""
    found: list[tuple[Line, list[str]]] = []
    waiting: list[str] = []
    for line in lines:
        text, hash_, _ = line.text.partition("#")
        comment = _comment(line.text[len(text) :])
        text = text.rstrip()
        if hash_ and not text and line.text.startswith(" "):
            if found:  # indented: it goes on about the one before
                found[-1][1].append(comment)
            continue
        if hash_:
            waiting.append(comment)
        if text:
            found.append((line._replace(text=text), waiting))
            waiting = []
    yield from found


def _comment(text: str) -> str:
    # Python takes no control characters in its source, which comments become a part of.
    return "".join(sign if sign.isprintable() else " " for sign in text.lstrip("#"))


def _joined(comments: Iterable[str]) -> str:
    return inspect.cleandoc("\n".join(comments))


def _check_unique(path: Path, members: Iterable[Field | Constant]) -> None:
    lines: dict[str, int] = {}
    for member in members:
        if member.name in lines:
            raise InterfaceError(
                path,
                member.line,
                f"expected a name of its own, found {member.name!r}, which line"
                f" {lines[member.name]} has",
            )
        lines[member.name] = member.line


def _field(line: Line, kind: str, rest: str, comment: str) -> Field:
    field_type = _field_type(line, kind)
    name, _, given = rest.partition(" ")
    given = given.strip()
    if not _NAME.fullmatch(name):
        raise line.expected("a field's name, like 'frame_id' (lower case, no '__')", name)
    default = None
    if given and field_type.is_message:
        raise line.expected("no default, as messages have their own", given)
    if given:
        default = read_value(line, field_type, given)
    return Field(line.number, field_type, name, default, comment)


def _constant(line: Line, kind: str, rest: str, comment: str) -> Constant:
    name, _, given = rest.partition("=")
    name, given = name.rstrip(), given.lstrip()
    if not _CONSTANT.fullmatch(name):
        raise line.expected("a constant's name, like 'MAX_SPEED', before the '='", name)
    if kind not in PRIMITIVES:
        raise line.expected("a constant's type, like 'int32' or 'string'", kind)
    return Constant(line.number, kind, name, read_single(line, FieldType(kind), given), comment)


def _field_type(line: Line, text: str) -> FieldType:
    wanted = "a type like 'int32', 'string<=10', 'float64[3]' or 'geometry_msgs/Pose'"
    parts = _TYPE.fullmatch(text)
    if parts is None:
        raise line.expected(wanted, text)
    base, package = parts["base"], ""
    if base in _OLD_NAMES:
        raise line.expected(repr(_OLD_NAMES[base]), text)
    if base not in PRIMITIVES:
        message = _MESSAGE.fullmatch(base)
        if message is None or not _NAME.fullmatch(message["package"] or "none"):
            raise line.expected(wanted, text)
        base, package = message["name"], message["package"] or ""
    characters = _number(parts["characters"])
    if characters is not None and base not in STRINGS:
        raise line.expected("'<=' behind a string only, or within '[]'", text)
    size, bounded = _number(parts["size"]), parts["most"] is not None
    return FieldType(
        base,
        package,
        characters,
        parts["array"] is not None,
        None if bounded else size,
        size if bounded else None,
    )


def _number(digits: str | None) -> int | None:
    return None if digits is None else int(digits)
