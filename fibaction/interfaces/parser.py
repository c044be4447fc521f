"""The parser of `.action` and `.msg` files.

A line means what it means to ROS's own parser, `rosidl_adapter/parser.py`: a `#` starts a comment
anywhere in a line, and a `=` makes a constant. A comment describes the field that it stands above,
behind, or (indented) below; a comment on top of a file describes the message.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from fibaction.interfaces.definitions import (
    ConstantDefinition,
    FieldDefinition,
    FieldType,
    InterfaceError,
    MessageDefinition,
    SourceLine,
)
from fibaction.interfaces.ros_types import PRIMITIVES
from fibaction.interfaces.values import STRINGS, read_single, read_value

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
    characters = _number(parts["characters"])
    if characters is not None and base not in STRINGS:
        raise line.error("'<=' behind a string only, or within '[]'", text)
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
