"""Where interface files lie, and an action with all messages that it nests.

A package may be laid out as ROS has it, `package/action/Type.action` and `package/msg/Type.msg`, in
a workspace or installed; or files just lie in a folder. Knows nothing of Python types.
"""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from fibaction.interfaces.definitions import Definition, Field, InterfaceError
from fibaction.interfaces.parsing import parse_action, parse_message

_PACKAGE = re.compile(r"(?!.*__)(?!.*_$)[a-z][a-z0-9_]*", re.ASCII)
_TYPE = re.compile(r"[A-Z][A-Za-z0-9]*", re.ASCII)

# https://github.com/ros2/rcl_interfaces/tree/rolling/builtin_interfaces/msg
_BUILTIN = {
    "Time": (
        "# A point in time, counted from 1970 (UTC), or in a simulation from its start.\n"
        "\n"
        "# Seconds, valid over all int32 values.\n"
        "int32 sec\n"
        "# Nanoseconds to be added, in the range [0, 1e9).\n"
        "uint32 nanosec\n"
    ),
    "Duration": (
        "# A span of time.\n"
        "\n"
        "# Seconds, valid over all int32 values.\n"
        "int32 sec\n"
        "# Nanoseconds to be added, in the range [0, 1e9).\n"
        "uint32 nanosec\n"
    ),
}


class Message(NamedTuple):
    """A message of an action, or one that is nested in it."""

    class_name: str
    """What its Python class is called."""
    full_name: str
    """What it is called in a sentence."""
    package: str
    """Empty if it is not known."""
    definition: Definition
    nested: dict[str, Message]
    """The messages in its fields, by the names of these."""


class ActionFile(NamedTuple):
    """An `.action` file, and what it nests."""

    path: Path
    name: str
    type_name: str
    """Empty if it is not known."""
    goal: Message
    result: Message
    feedback: Message

    def messages(self) -> list[Message]:
        """All messages, each once, and after those that it nests."""
        found: dict[str, Message] = {}
        for part in (self.goal, self.result, self.feedback):
            for message in _inside_out(part):
                found.setdefault(message.class_name, message)
        return list(found.values())


def _inside_out(message: Message) -> Iterator[Message]:
    for nested in message.nested.values():
        yield from _inside_out(nested)
    yield message


def read_action(
    path: str | os.PathLike[str],
    *,
    name: str = "",
    type_name: str = "",
    search: Iterable[str | os.PathLike[str]] = (),
) -> ActionFile:
    """Read an `.action` file and the `.msg` files that it needs; see `load_action`.

    Raises:
        InterfaceError: A file is malformed, or a message is nowhere.
        OSError: The file cannot be read.
    """
    path = Path(path)
    text = _text_of(path)
    if not _TYPE.fullmatch(path.stem):
        problem = f"expected a file that is called like 'Fibonacci.action', found {path.name!r}"
        raise InterfaceError(path, 1, problem)
    package = type_name.partition("/")[0] if type_name else _package_of(path, "action")
    if package and not type_name:
        type_name = f"{package}/action/{path.stem}"
    found = _Messages(package, [*_around(path, "action"), *map(Path, search), *_of_ros()])
    definitions = parse_action(text, path)
    found.read(definitions)
    goal, result, feedback = (
        found.message(definition, package, f"the {part} of `{path.stem}`")
        for definition, part in zip(definitions, ("goal", "result", "feedback"), strict=True)
    )
    return ActionFile(path, name or _snake(path.stem), type_name, goal, result, feedback)


def _snake(name: str) -> str:
    """`NavigateToPose` as `navigate_to_pose`."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return parts.lower()


def _package_of(path: Path, folder: str) -> str:
    """The package that a file is of, from the folders that it lies in."""
    here = path.absolute().parent
    package = here.parent.name
    return package if here.name == folder and _PACKAGE.fullmatch(package) else ""


def _around(path: Path, folder: str) -> list[Path]:
    """Where a file's own package and its neighbours are."""
    here = path.absolute().parent
    return [here.parent.parent, here] if _package_of(path, folder) else [here]


def _of_ros() -> Iterator[Path]:
    """Where ROS has the interfaces that are installed: those of the setup.bash that has been
    sourced, and those of wheels in the environment of this Python.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix, "share")
    share = Path(sys.prefix, "share")
    if (share / "ament_index").is_dir():  # or an error would name a folder that is not of ROS
        yield share


def _text_of(path: Path) -> str:
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as exc:
        line = data.count(b"\n", 0, exc.start) + 1
        raise InterfaceError(path, line, f"expected text in UTF-8, found {exc.reason}") from exc


class _Messages:
    """The messages that are nested somewhere in an action."""

    def __init__(self, package: str, roots: list[Path]) -> None:
        self._package = package
        self._roots = roots
        self._definitions: dict[tuple[str, str], Definition] = {}
        self._made: dict[tuple[str, str], Message] = {}
        self._namesakes: Counter[str] = Counter()

    def read(self, definitions: Iterable[Definition]) -> None:
        """Read the files of all that these nest."""
        for definition in definitions:
            self._read(definition, self._package, ())
        self._namesakes = Counter(name for _, name in self._definitions)

    def _read(
        self, definition: Definition, package: str, above: tuple[tuple[str, str], ...]
    ) -> None:
        for field in definition.fields:
            if not field.type.is_message:
                continue
            key = (field.type.package or package, field.type.base)
            if key in above:
                text = f"expected no message that is nested in itself, found {_full(*key)!r}"
                raise InterfaceError(definition.path, field.line, text)
            if key not in self._definitions:
                nested = self._definition(definition.path, field, *key)
                self._read(nested, key[0], (*above, key))
                self._definitions[key] = nested

    def _definition(self, user: Path, field: Field, package: str, name: str) -> Definition:
        for path in self._places(package, name):
            if path.is_file():
                return parse_message(_text_of(path), path)
        if package == "builtin_interfaces" and name in _BUILTIN:
            return parse_message(_BUILTIN[name], Path(package, "msg", f"{name}.msg"))
        looked = ", ".join(dict.fromkeys(map(str, self._roots)))
        raise InterfaceError(
            user,
            field.line,
            f"expected {_full(package, name)!r} on the search path, found no"
            f" {Path(package, 'msg', f'{name}.msg')} and no {name}.msg in {looked}",
        )

    def _places(self, package: str, name: str) -> Iterator[Path]:
        file = f"{name}.msg"
        for root in self._roots:
            if package:
                yield root / package / "msg" / file
            own = root.absolute()
            if own.name == package or not package:
                yield root / "msg" / file
            # A folder `msg` of another package has another message of that name.
            if own.name != "msg" or own.parent.name == package or not package:
                yield root / file

    def message(self, definition: Definition, package: str, full_name: str = "") -> Message:
        """A message with all that it nests; `read` has been here before."""
        nested: dict[str, Message] = {}
        for field in definition.fields:
            if field.type.is_message:
                key = (field.type.package or package, field.type.base)
                if key not in self._made:
                    self._made[key] = self.message(self._definitions[key], key[0])
                nested[field.name] = self._made[key]
        name = definition.name
        if self._namesakes[name] > 1 and not full_name:
            name = f"{package}_{name}"
        full_name = full_name or f"`{_full(package, definition.name)}`"
        return Message(name, full_name, package, definition, nested)


def _full(package: str, name: str) -> str:
    return f"{package}/{name}" if package else name
