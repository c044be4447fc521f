"""What is printed: values as YAML text, as `ros2 action` shows them, or JSON, one value a line."""

from __future__ import annotations

import base64
import datetime
import json
import logging
import math
import re
import sys
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING, Any, TextIO, TypeGuard

import click
import msgspec

from fibaction.cli.escape import clean, clean_json
from fibaction.cli.exit_codes import ExitCode, Failure

if TYPE_CHECKING:
    from rich.console import Console

MOST_ITEMS = 128
"""Items of a list that are shown unless all are wanted; `ros2 topic echo` shows as many."""
MOST_CHARACTERS = 1000
"""Of a text or of bytes: some screens full would be of no use to a person."""
DEEPEST = 50
"""Levels of nesting that are shown. Nobody reads more, and Python could not recurse for ever."""

_PLAIN = re.compile(r"(?:[^\W\d]|/)(?:[\w ./()+-]*[\w./()+-])?")
# What would be read as something else than text. YAML 1.1 has `y` and `n` there as well, but hardly
# any reader does, and half of what robots send has a field `y`.
_NOT_TEXT = {"yes", "no", "on", "off", "true", "false", "null"}


def say(text: str = "") -> None:
    """Print a line, or several, to stdout, at once."""
    click.echo(text)


def note(text: str) -> None:
    """Print a remark for the person to stderr, where it is in nobody's way. It is on one line, and
    what a server has said in it cannot control the terminal.
    """
    # Not by click, which would find its way past what rich puts here to protect a live line.
    sys.stderr.write(f"{clean(text)}\n")
    sys.stderr.flush()


class LogHandler(logging.StreamHandler[TextIO]):
    """Writes the log where `note` writes."""

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr  # what is there now: rich may have come since, or gone
        super().emit(record)


def say_json(value: Any) -> None:
    """Print a value as one line of JSON."""
    click.echo(as_json(value))


def console() -> Console:
    """A rich console on stdout: with colours on a terminal only, and none with `NO_COLOR`."""
    from rich.console import Console

    # Numbers and paths in what others have written are not to be coloured, nor `[tags]` obeyed.
    return Console(highlight=False, markup=False, emoji=False)


def on_terminal() -> bool:
    """Whether stdout is a terminal on which a line can be drawn anew."""
    found = console()
    return found.is_terminal and not found.is_dumb_terminal


def is_map(value: object) -> TypeGuard[dict[Any, Any]]:
    """Whether it is a map, of whatever."""
    return isinstance(value, dict)


def is_list(value: object) -> TypeGuard[Collection[Any]]:
    """Whether it is a list, or what is printed as one."""
    return isinstance(value, list | tuple | set | frozenset)


def as_json(value: Any) -> str:
    """The value as JSON: bytes become base64, times ISO 8601, NaN and infinities null.

    Raises:
        Failure: JSON cannot express it.
    """
    try:
        return clean_json(msgspec.json.encode(value, enc_hook=_plain).decode())
    except (TypeError, ValueError, RecursionError) as exc:
        raise Failure(f"it cannot be written as JSON: {exc}", ExitCode.ABORTED) from exc


def as_yaml(value: Any, *, full: bool = False, indent: int = 0) -> str:
    """The value as YAML, in block style. Without `full`, long lists, texts and bytes are cut, and a
    comment says how much is left out.
    """
    most = _Most(MOST_ITEMS, MOST_CHARACTERS) if not full else _Most(math.inf, math.inf)
    return "\n".join(" " * indent + line for line in _lines(value, most, 0))


class _Most(msgspec.Struct, frozen=True):
    items: float
    characters: float


def _plain(value: Any) -> Any:
    if isinstance(value, msgspec.msgpack.Ext):
        return {"ext": value.code, "data": base64.b64encode(value.data).decode()}
    raise TypeError(f"a {type(value).__name__} is nothing that JSON has")


def _lines(value: Any, most: _Most, depth: int) -> Iterator[str]:
    if depth > DEEPEST:
        yield f"null  # ... there is more, deeper than {DEEPEST} levels"
    elif is_map(value) and value:
        yield from _mapping(value, most, depth)
    elif is_list(value) and value:
        yield from _sequence(value, most, depth)
    else:
        yield _scalar(value, most)


def _mapping(value: dict[Any, Any], most: _Most, depth: int) -> Iterator[str]:
    for key, item in value.items():
        name = _scalar(key, most)
        if is_map(item) and item:
            yield f"{name}:"
            yield from (f"  {line}" for line in _lines(item, most, depth + 1))
        elif is_list(item) and item:
            yield f"{name}:"
            yield from _lines(item, most, depth + 1)
        else:
            yield f"{name}: {_scalar(item, most)}"


def _sequence(value: Collection[Any], most: _Most, depth: int) -> Iterator[str]:
    items = list(value)
    shown = items if len(items) <= most.items else items[: int(most.items)]
    for item in shown:
        mark = "- "
        for line in _lines(item, most, depth + 1):
            yield mark + line
            mark = "  "
    if len(shown) < len(items):
        yield f"# ... and {len(items) - len(shown)} more"


def _scalar(value: Any, most: _Most) -> str:
    match value:
        case None:
            return "null"
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            return _number(value)
        case str():
            return _text(value, most)
        case bytes():
            return _binary(value, most)
        case msgspec.msgpack.Ext():
            return _quoted(f"extension {value.code}: {base64.b64encode(value.data).decode()}")
        case datetime.date():  # a datetime is one, too
            return value.isoformat()
        case dict() if not value:
            return "{}"
        case list() | tuple() | set() | frozenset() if not value:
            return "[]"
        case _:
            return _quoted(str(value))


def _number(value: float) -> str:
    if math.isnan(value):
        return ".nan"
    if math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    # YAML 1.1 wants a dot in front of an exponent.
    return re.sub(r"^(-?\d+)e", r"\1.0e", repr(value))


def _text(value: str, most: _Most) -> str:
    if len(value) > most.characters:
        shown = value[: int(most.characters)]
        return f"{_quoted(shown)}  # ... and {len(value) - len(shown)} more characters"
    if _PLAIN.fullmatch(value) and value.lower() not in _NOT_TEXT and value.isprintable():
        return value
    return _quoted(value)


def _binary(value: bytes, most: _Most) -> str:
    shown = value if len(value) <= most.characters else value[: int(most.characters)]
    text = f'!!binary "{base64.b64encode(shown).decode()}"'
    return text if shown is value else f"{text}  # ... and {len(value) - len(shown)} more bytes"


def _quoted(value: str) -> str:
    return clean(json.dumps(value, ensure_ascii=False))
