"""The search for interface files, and an action with all messages that it nests.

A package has the layout of ROS, `package/action/Type.action` and `package/msg/Type.msg`, in a
workspace or installed; or files lie in a folder side by side. `fibaction.interfaces.packages` knows
where they may be.
"""

from __future__ import annotations

import os
import re
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from fibaction.interfaces.definitions import FieldDefinition, InterfaceError, MessageDefinition
from fibaction.interfaces.packages import (
    MOST_BYTES,
    PACKAGE,
    SearchPath,
    advice,
    common_message,
    package_of,
    read_bytes,
)
from fibaction.interfaces.parser import parse_action, parse_message, parse_service

MAX_DEPTH = 100
"""Levels of messages within messages."""
MAX_MESSAGES = 100_000
"""Messages within one message, all levels and elements of arrays of a fixed size counted."""

_TYPE = re.compile(r"[A-Z][A-Za-z0-9]*", re.ASCII)
_ACTION = re.compile(r"action/[A-Z][A-Za-z0-9]*", re.ASCII)
_LONG_NAME = re.compile(r"[a-z][a-z0-9_]*/(msg|srv)/[A-Z][A-Za-z0-9]*", re.ASCII)

_ROS_1_HINTS = {"Header": "; in ROS 2 it is 'std_msgs/Header'"}
"""The advice of an error about names of ROS 1, by the name of the type."""

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


# https://github.com/ros2/common_interfaces/tree/rolling/std_srvs/srv
_SERVICES = {
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message\n",
}
"""The services that are known without a file."""


class InterfaceMessage(NamedTuple):
    """A message of an action, or a message that is nested in one."""

    class_name: str
    """The name of its Python class."""
    full_name: str
    """Its name in a sentence, for example "the goal of `Fibonacci`"."""
    package: str
    """Empty if unknown."""
    definition: MessageDefinition
    nested: dict[str, InterfaceMessage]
    """The messages in its fields, by field name."""
    type_name: str = ""
    """Its ROS 2 type, for example `geometry_msgs/msg/Pose`; empty if the package is unknown."""


class ActionFile(NamedTuple):
    """An `.action` file, with the messages that it nests."""

    path: Path
    name: str
    type_name: str
    """Empty if unknown."""
    goal: InterfaceMessage
    result: InterfaceMessage
    feedback: InterfaceMessage

    def texts(self) -> dict[str, str]:
        """Return the text of the file by the type of the action, and those of the messages that it
        nests by theirs; `read_action_texts` reads them again.
        """
        parts = (self.goal, self.result, self.feedback)
        found = {self.type_name: "---\n".join(part.definition.text for part in parts)}
        found |= {one.type_name: one.definition.text for one in self.messages() if one not in parts}
        return found

    def messages(self) -> list[InterfaceMessage]:
        """Return all messages, each once, and each after those that it nests."""
        return inside_out(self.goal, self.result, self.feedback)


class ServiceFile(NamedTuple):
    """A `.srv` file, with the messages that it nests."""

    request: InterfaceMessage
    response: InterfaceMessage

    @property
    def type_name(self) -> str:
        """The ROS 2 type, for example `std_srvs/srv/Trigger`."""
        return self.request.type_name.removesuffix("_Request")

    @property
    def text(self) -> str:
        """The text of the file."""
        return "---\n".join(part.definition.text for part in (self.request, self.response))


def inside_out(*messages: InterfaceMessage) -> list[InterfaceMessage]:
    """Return messages and all that they nest, each once, and each after those that it nests."""
    found: dict[str, InterfaceMessage] = {}
    for message in messages:
        _add_inside_out(message, found)
    return list(found.values())


def _add_inside_out(message: InterfaceMessage, found: dict[str, InterfaceMessage]) -> None:
    if message.class_name not in found:
        for nested in message.nested.values():
            _add_inside_out(nested, found)
        found[message.class_name] = message


def read_action(
    path: str | os.PathLike[str],
    *,
    name: str = "",
    type_name: str = "",
    search: Iterable[str | os.PathLike[str]] = (),
) -> ActionFile:
    """Read an `.action` file and the `.msg` files that it needs; see `load_action`.

    Raises:
        InterfaceError: A file is malformed, or a nested message is not found.
        OSError: The file cannot be read.
    """
    path = Path(path)
    text = _text_of(path)
    if not _TYPE.fullmatch(path.stem):
        problem = f"expected a file name like 'Fibonacci.action', found {path.name!r}"
        raise InterfaceError(path, 1, problem)
    package = type_name.partition("/")[0] if type_name else package_of(path)
    if package and not type_name:
        type_name = f"{package}/action/{path.stem}"
    found = _Messages(package, SearchPath.around(path, [*map(Path, search)]), {})
    return _action(path, text, found, name, type_name)


def read_action_texts(type_name: str, texts: Mapping[str, str], *, name: str = "") -> ActionFile:
    """Read an action from texts, by the types that they define; no file is searched for.

    Raises:
        InterfaceError: A text is malformed, or that of the action or a nested message is missing.
    """
    path = Path(f"{type_name}.action")
    package, _, rest = type_name.partition("/")
    if type_name not in texts or not PACKAGE.fullmatch(package) or not _ACTION.fullmatch(rest):
        problem = f"expected a type like 'example_interfaces/action/Fibonacci', found {type_name!r}"
        raise InterfaceError(path, 1, problem)
    return _action(
        path, texts[type_name], _Messages(package, SearchPath((), ()), texts), name, type_name
    )


def read_message(type_name: str, search: SearchPath) -> InterfaceMessage:
    """Read a message by its type, such as `nav_msgs/msg/Odometry`, and all that it nests.

    Raises:
        InterfaceError: This is not the name of a message, its file is malformed, or it is not
            found.
        OSError: A file cannot be read.
    """
    if type_name in _DEFINED:
        return read_message_texts(type_name, _DEFINED)
    return _message(type_name, search, {})


def read_message_texts(type_name: str, texts: Mapping[str, str]) -> InterfaceMessage:
    """Read a message from texts, by the types that they define; no file is searched for.

    Raises:
        InterfaceError: A text is malformed or missing.
    """
    return _message(type_name, SearchPath((), ()), texts)


def _message(type_name: str, search: SearchPath, texts: Mapping[str, str]) -> InterfaceMessage:
    package, name = _named(type_name, "msg", "std_msgs/msg/String")
    found = _Messages(package, search, texts)
    outer = parse_message(f"{package}/{name} message\n", Path(type_name))
    found.read([outer])
    return found.message(outer, package).nested["message"]


def read_service(type_name: str, search: SearchPath) -> ServiceFile:
    """Read a service by its type, such as `std_srvs/srv/Trigger`; see `read_message`.

    Raises:
        InterfaceError: As for `read_message`.
        OSError: A file cannot be read.
    """
    package, name = _named(type_name, "srv", "std_srvs/srv/Trigger")
    if type_name in _DEFINED:
        return _service(Path(f"{type_name}.srv"), _DEFINED[type_name], package, SearchPath((), ()))
    places = (
        root / place
        for root in search.roots
        for place in (f"{type_name}.srv", f"srv/{name}.srv", f"{name}.srv")
    )
    path = next((path for path in places if path.is_file()), None)
    text = _SERVICES.get(type_name) if path is None else _text_of(path)
    if text is None:
        roots = ", ".join(dict.fromkeys(map(str, search.roots))) or "no folder"
        problem = f"expected {package}/srv/{name}.srv in {roots}, found none"
        raise InterfaceError(Path(type_name), 1, problem)
    return _service(path or Path(f"{type_name}.srv"), text, package, search)


def read_interface(path: Path, search: Sequence[Path]) -> InterfaceMessage | ServiceFile:
    """Read a `.msg` or a `.srv` file in the folder of its package.

    Raises:
        InterfaceError: It is not in a package, is malformed, or nests what is not found.
        OSError: The file cannot be read.
    """
    text, package = _text_of(path), package_of(path)
    if not package:
        raise InterfaceError(path, 1, f"expected a file such as my_msgs/{path.suffix[1:]}/Name")
    around = SearchPath.around(path, search)
    if path.suffix == ".srv":
        return _service(path, text, package, around)
    return _message(f"{package}/msg/{path.stem}", around, {})


def _service(path: Path, text: str, package: str, search: SearchPath) -> ServiceFile:
    parts = parse_service(text, path)
    found = _Messages(package, search, _DEFINED if not search.roots else {})
    found.read(parts)
    request, response = (
        found.message(part, package, f"the {word} of `{path.stem}`", "srv")
        for part, word in zip(parts, ("request", "response"), strict=True)
    )
    return ServiceFile(request, response)


def _named(type_name: str, folder: str, example: str) -> tuple[str, str]:
    package, _, name = type_name.partition(f"/{folder}/")
    if not _LONG_NAME.fullmatch(type_name) or not name:
        problem = f"expected a type like {example!r}, found {type_name!r}"
        raise InterfaceError(Path(type_name), 1, problem)
    return package, name


def _action(path: Path, text: str, found: _Messages, name: str, type_name: str) -> ActionFile:
    definitions = parse_action(text, path)
    found.read(definitions)
    goal, result, feedback = (
        found.message(definition, found.package, f"the {part} of `{path.stem}`")
        for definition, part in zip(definitions, ("goal", "result", "feedback"), strict=True)
    )
    return ActionFile(path, name or _snake(path.stem), type_name, goal, result, feedback)


def _snake(name: str) -> str:
    """Return a name in snake case: `navigate_to_pose` for `NavigateToPose`."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return parts.lower()


def _text_of(path: Path) -> str:
    data = read_bytes(path)
    if data.startswith(BOM_UTF8):
        raise InterfaceError(path, 1, "expected text without a byte order mark, found one")
    try:
        # What was cut within a character is too large anyway.
        return data.decode(errors="ignore" if len(data) == MOST_BYTES else "strict")
    except UnicodeDecodeError as exc:
        line = data.count(b"\n", 0, exc.start) + 1
        raise InterfaceError(path, line, f"expected text in UTF-8, found {exc.reason}") from exc


class _Extent(NamedTuple):
    """The size of a message with its defaults."""

    messages: int
    """The message itself, and all messages in it."""
    levels: int
    """Levels of messages in it."""

    def with_field(self, field: FieldDefinition, nested: _Extent) -> _Extent:
        """Return the extent of a message that has one more field."""
        times = (field.type.size or 0) if field.type.is_array else 1
        messages = self.messages + times * nested.messages
        return _Extent(messages, max(self.levels, 1 + nested.levels))


def _too_deep(definition: MessageDefinition, field: FieldDefinition) -> InterfaceError:
    text = f"expected at most {MAX_DEPTH} levels of messages, found more"
    return InterfaceError(definition.path, field.line, text)


class _Messages:
    """The messages that are nested in an action, at any depth."""

    def __init__(self, package: str, search: SearchPath, texts: Mapping[str, str]) -> None:
        """`texts` are those of messages that need no file, by their types."""
        self.package = package
        self._search = search
        self._texts = texts
        self._definitions: dict[tuple[str, str], MessageDefinition] = {}
        self._made: dict[tuple[str, str], InterfaceMessage] = {}
        self._extents: dict[tuple[str, str], _Extent] = {}
        self._namesakes: Counter[str] = Counter()

    def read(self, definitions: Iterable[MessageDefinition]) -> None:
        """Read the files of all messages that the definitions nest."""
        for definition in definitions:
            self._read(definition, self.package, ())
        self._namesakes = Counter(name for _, name in self._definitions)

    def _read(
        self, definition: MessageDefinition, package: str, above: tuple[tuple[str, str], ...]
    ) -> _Extent:
        extent = _Extent(1, 0)
        for field in definition.fields:
            if not field.type.is_message:
                continue
            key = (field.type.package or package, field.type.base)
            if key in above:
                text = f"expected a message that does not contain itself, found {_full(*key)!r}"
                raise InterfaceError(definition.path, field.line, text)
            if len(above) >= MAX_DEPTH:
                raise _too_deep(definition, field)
            if key not in self._definitions:
                nested = self._definition(definition.path, field, *key)
                self._extents[key] = self._read(nested, key[0], (*above, key))
                self._definitions[key] = nested
            extent = extent.with_field(field, self._extents[key])
            if extent.levels > MAX_DEPTH:
                raise _too_deep(definition, field)
            if extent.messages > MAX_MESSAGES:
                text = (
                    f"expected at most {MAX_MESSAGES:,} messages in one, found {extent.messages:,}"
                )
                raise InterfaceError(definition.path, field.line, text)
        return extent

    def _definition(
        self, user: Path, field: FieldDefinition, package: str, name: str
    ) -> MessageDefinition:
        text = self._texts.get(f"{package}/msg/{name}")
        if text is not None:
            return parse_message(text, Path(package, "msg", f"{name}.msg"))
        for path in self._search.places(package, name):
            if path.is_file():
                return parse_message(_text_of(path), path)
        if package == "builtin_interfaces" and name in _BUILTIN:
            return parse_message(_BUILTIN[name], Path(package, "msg", f"{name}.msg"))
        common = common_message(package, name)
        if common is not None:
            return parse_message(common, Path(package, "msg", f"{name}.msg"))
        roots = ", ".join(dict.fromkeys(map(str, self._search.roots)))
        raise InterfaceError(
            user,
            field.line,
            f"expected {_full(package, name)!r} on the search path, found no"
            f" {Path(package, 'msg', f'{name}.msg')} and no {name}.msg in {roots}"
            f"{advice(package)}{'' if field.type.package else _ROS_1_HINTS.get(name, '')}",
        )

    def message(
        self,
        definition: MessageDefinition,
        package: str,
        full_name: str = "",
        folder: str = "action",
    ) -> InterfaceMessage:
        """Return a message with all that it nests, which `read` has read before. One with a full
        name is a part of what is in the folder of its package.
        """
        nested: dict[str, InterfaceMessage] = {}
        for field in definition.fields:
            if field.type.is_message:
                key = (field.type.package or package, field.type.base)
                if key not in self._made:
                    self._made[key] = self.message(self._definitions[key], key[0])
                nested[field.name] = self._made[key]
        name = definition.name
        folder = folder if full_name else "msg"
        type_name = f"{package}/{folder}/{name}" if package else ""
        if self._namesakes[name] > 1 and not full_name:
            name = f"{package}_{name}"
        full_name = full_name or f"`{_full(package, definition.name)}`"
        return InterfaceMessage(name, full_name, package, definition, nested, type_name)


def _full(package: str, name: str) -> str:
    return f"{package}/{name}" if package else name


_DEFINED: dict[str, str] = {}
"""The texts of messages and services that modules define."""
_KNOWN: dict[str, ActionFile] = {}
_TEXTS: dict[str, Mapping[str, str]] = {}
"""The texts of the types that are not read yet."""


def remember(action: ActionFile) -> None:
    """Remember a file for transports that need its definitions; of one type the last one counts."""
    if action.type_name:
        _TEXTS.pop(action.type_name, None)
        _KNOWN[action.type_name] = action


def define_action(type_name: str, texts: Mapping[str, str]) -> None:
    """Define a ROS 2 action type for `dds://`, which then needs no file of it.

    Modules that `fibaction gen` has written call it. `texts` are the texts of the `.action` file
    and of the `.msg` files that it nests, by the types that they define, such as
    `geometry_msgs/msg/Pose`. They are read when the type is first used.
    """
    _TEXTS[type_name] = texts


def define_types(texts: Mapping[str, str]) -> None:
    """Define messages and services of ROS 2 for `dds://` and `zenoh://`, which then need no files
    of them.

    Modules that `fibaction gen` has written call it. `texts` are those of the `.msg` and `.srv`
    files, and of the messages that they nest, by the types that they define.
    """
    _DEFINED.update(texts)


def known_action(type_name: str) -> ActionFile | None:
    """Return the file of a type; None if it was neither loaded nor defined.

    Raises:
        InterfaceError: The texts that define it are malformed.
    """
    if type_name in _TEXTS:
        _KNOWN[type_name] = read_action_texts(type_name, _TEXTS[type_name])
        del _TEXTS[type_name]
    return _KNOWN.get(type_name)
