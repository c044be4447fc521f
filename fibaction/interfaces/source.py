"""The messages of an action, or of all actions of a robot, as the source of a Python module.

The classes are those of `fibaction.interfaces.structs`, with the same JSON Schemas. Each field is
one line, however long: a formatter lays the source out better than code here could.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from fibaction.interfaces.definitions import FieldDefinition, FieldType, InterfaceError
from fibaction.interfaces.files import (
    ActionFile,
    InterfaceMessage,
    ServiceFile,
    inside_out,
    read_action_texts,
)
from fibaction.interfaces.ros_types import PRIMITIVES, attribute
from fibaction.interfaces.structs import docstring, is_bytes, make_structs, plain_default

_STANDARD = ("builtins", "typing")
_LIMITED = {
    name: name.title().replace("Ui", "UI")
    for name, kind in PRIMITIVES.items()
    if not isinstance(kind, type)
}
"""The names in `fibaction.ros_types` of the primitives that have limits."""


def python_source(action: ActionFile) -> str:
    """Return the source of a module with a class for each message, and the action.

    The action is a constant with its name in capitals.
    """
    about = [
        f'"""The messages of `{action.type_name or action.path.stem}`.',
        "",
        f"Written by `fibaction gen` from {action.path.name}.",
        "Change that file, not this one.",
        '"""',
    ]
    return _module_source([action], about)


def types_source(types: Sequence[InterfaceMessage | ServiceFile]) -> str:
    """Return the source of a module with a class for each message, and a constant for each service.

    Raises:
        ValueError: Two messages of different packages have one name.
    """
    services = [one for one in types if isinstance(one, ServiceFile)]
    outer = [one for one in types if isinstance(one, InterfaceMessage)]
    parts = inside_out(*outer, *(part for one in services for part in one))
    for one in outer:
        if one not in parts:
            raise ValueError(
                f"{one.type_name} has the name of another message: write each to a file of its own"
            )
    texts = {one.type_name: one.definition.text for one in parts if "/srv/" not in one.type_name}
    texts |= {one.type_name: one.text for one in services}
    listed = ", ".join(f"`{one.type_name}`" for one in types)
    about = [f'"""The types {listed}.', "", "Written by `fibaction gen`.", '"""']
    names = _Names(_names_in(parts))
    made: list[str] = []
    for service in services:
        name = service.type_name.rpartition("/")[2]
        constant = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).upper()
        made += [f"{constant} = {names.use('Service', 'fibaction_transports.ros2')}("]
        made += [f"    {_literal(service.type_name)},", f"    {service.request.class_name},"]
        made += [f"    {service.response.class_name},", ")", ""]
    made += [f"{names.use('define_types', 'fibaction.action_files')}(", "    {"]
    for type_name, text in texts.items():
        made.append(f"        {_literal(type_name)}: {_literal(_without_comments(text))},")
    classes = _classes(parts, names, is_typed=True)
    return "\n".join([*about, *names.imports(), *classes, "", "", *made, "    }", ")", ""])


_ABOUT = (
    '"""The actions of a robot, and their messages.',
    "",
    "Written by `fibaction gen --from-robot`.",
    "If the types of the robot change, write it again.",
    '"""',
)


class RobotSource:
    """Collects actions, and writes them into one module. They may share messages."""

    def __init__(self) -> None:
        self._actions: list[ActionFile] = []
        self._fields: dict[str, Sequence[object]] = {}
        """The fields of all messages, by their types."""

    def __len__(self) -> int:
        return len(self._actions)

    def add(self, name: str, type_name: str, texts: Mapping[str, str]) -> None:
        """Add an action, by the texts of its interface files.

        Raises:
            InterfaceError: A text is malformed, or defines another version of a type that an
                earlier action has.
        """
        action = read_action_texts(type_name, texts, name=name)
        own = {one.type_name: _fields(one) for one in action.messages()}
        for one, fields in own.items():
            if self._fields.get(one, fields) != fields:
                problem = f"expected {one} as in the other actions, found another version of it"
                raise InterfaceError(action.path, 1, problem)
        make_structs(action)  # raises now what the module would raise on import
        self._fields |= own
        self._actions.append(action)

    def source(self) -> str:
        """Return the source of the module."""
        return _module_source(_united(self._actions), _ABOUT)


def _module_source(actions: Sequence[ActionFile], about: Iterable[str]) -> str:
    """Return the source of a module with these actions, and with a class for each message of all.

    Messages of one class name must be the same. `about` are the lines of the docstring.
    """
    found = {one.class_name: one for action in actions for one in action.messages()}
    messages = list(found.values())
    names = _Names(_names_in(messages))
    shadowed = {name for message in messages for name in _shadowed(message)}
    classes = _classes(messages, names)
    taken = {*found, *(f"{name}_" for name in shadowed)}
    made = [line for action in actions for line in ("", *_action(action, taken, names))]
    by_type = {action.type_name: action for action in actions if action.type_name}
    defined = [line for action in by_type.values() for line in _definition(action, names)]
    return "\n".join([*about, *names.imports(), *classes, "", *made, *defined, ""])


def _classes(
    messages: Sequence[InterfaceMessage], names: _Names, *, is_typed: bool = False
) -> list[str]:
    shadowed = {name for message in messages for name in _shadowed(message)}
    classes: list[str] = []
    for message in messages:
        classes += ["", "", *_class(message, names, is_typed=is_typed)]
        if message.class_name in shadowed:
            classes += ["", "", f"{message.class_name}_ = {message.class_name}"]
    return classes


def _action(action: ActionFile, taken: set[str], names: _Names) -> Iterator[str]:
    """Yield an action as a constant, whose name becomes one of those that are taken."""
    constant = re.sub(r"\W+", "_", action.name).strip("_").upper()
    while constant in taken:
        constant += "_"
    taken.add(constant)
    yield f"{constant} = {names.use('Action', 'fibaction')}("
    yield f"    {_literal(action.name)},"
    yield f"    goal={action.goal.class_name},"
    yield f"    feedback={action.feedback.class_name},"
    yield f"    result={action.result.class_name},"
    if action.type_name:
        yield f"    type_name={_literal(action.type_name)},"
    yield ")"


def _definition(action: ActionFile, names: _Names) -> Iterator[str]:
    """Yield the call that defines the type for `dds://`."""
    yield ""
    yield f"{names.use('define_action', 'fibaction.action_files')}("
    yield f"    {_literal(action.type_name)},"
    yield "    {"
    for type_name, text in action.texts().items():
        yield f"        {_literal(type_name)}: {_literal(_without_comments(text))},"
    yield "    },"
    yield ")"


def _without_comments(text: str) -> str:
    lines = (line.partition("#")[0].rstrip() for line in text.splitlines())
    return "".join(f"{line}\n" for line in lines if line)


class _Names:
    """The names that the module imports.

    A name that is taken by a message or a field is imported with `_` behind it, with which no name
    in an interface file ends.
    """

    def __init__(self, taken: Iterable[str]) -> None:
        self._taken = frozenset(taken)
        self._used: defaultdict[str, set[str]] = defaultdict(set)

    def use(self, name: str, module: str = "builtins") -> str:
        """Return the name by which the module's code refers to `name`, and import it."""
        alias = f"{name}_" if name in self._taken else name
        if module != "builtins" or alias != name:
            self._used[module].add(name if alias == name else f"{name} as {alias}")
        return alias

    def imports(self) -> Iterator[str]:
        """Yield the import statements, those of the standard library first."""
        for standard in (True, False):
            block = [module for module in sorted(self._used) if (module in _STANDARD) is standard]
            if block:
                yield ""
            for module in block:
                yield f"from {module} import {', '.join(sorted(self._used[module]))}"


def _names_in(messages: Iterable[InterfaceMessage]) -> Iterator[str]:
    for message in messages:
        yield message.class_name
        yield from (field.name for field in message.definition.fields)
        yield from (constant.name for constant in message.definition.constants)


def _shadowed(message: InterfaceMessage) -> set[str]:
    """Return the nested classes that have the name of a field or a constant of the message.

    In its class that name is the field's or the constant's; the class has a `_` behind it there.
    """
    definition = message.definition
    own = {one.name for part in (definition.fields, definition.constants) for one in part}
    return own & {nested.class_name for nested in message.nested.values()}


def _class(message: InterfaceMessage, names: _Names, *, is_typed: bool = False) -> Iterator[str]:
    struct = names.use("Struct", "msgspec")
    yield f"class {message.class_name}({struct}, forbid_unknown_fields=True, kw_only=True):"
    yield from _indented(_docstring(docstring(message)))
    if message.definition.constants or is_typed:
        yield ""
    if is_typed:
        kind = f"{names.use('ClassVar', 'typing')}[{names.use('str')}]"
        yield f"    __ros_type__: {kind} = {_literal(message.type_name)}"
    for constant in message.definition.constants:
        yield from _indented(f"# {line}" for line in constant.comment.splitlines())
        kind = f"{names.use('ClassVar', 'typing')}[{names.use(type(constant.value).__name__)}]"
        yield f"    {constant.name}: {kind} = {_literal(constant.value)}"
    if message.definition.fields:
        yield ""
    shadowed = _shadowed(message)
    for field in message.definition.fields:
        nested = message.nested.get(field.name)
        class_name = nested.class_name if nested else ""
        class_name += "_" * (class_name in shadowed)
        kind, default = _annotation(field, class_name, names), _default(field, class_name, names)
        yield f"    {attribute(field.name)}: {kind} = {default}"


def _indented(lines: Iterable[str]) -> Iterator[str]:
    return (f"    {line}".rstrip() for line in lines)


def _docstring(text: str) -> list[str]:
    text = text.replace("\\", "\\\\")
    if '"""' in text or text.endswith('"'):
        text = text.replace('"', '\\"')
    return f'"""{text}"""'.split("\n") if "\n" not in text else [*f'"""{text}'.split("\n"), '"""']


def _annotation(field: FieldDefinition, nested: str, names: _Names) -> str:
    kind, limits = _type_of(field.type, nested, names)
    if field.comment:
        limits = [*limits, f"description={_literal(field.comment)}"]
    return _annotated(kind, limits, names)


def _annotated(kind: str, limits: list[str], names: _Names) -> str:
    if not limits:
        return kind
    meta = f"{names.use('Meta', 'msgspec')}({', '.join(limits)})"
    return f"{names.use('Annotated', 'typing')}[{kind}, {meta}]"


def _type_of(kind: FieldType, nested: str, names: _Names) -> tuple[str, list[str]]:
    """Return a type and the limits of its values."""
    if is_bytes(kind):
        single = names.use("bytes")
    elif nested:
        single = nested
    elif kind.base in _LIMITED:
        single = names.use(_LIMITED[kind.base], "fibaction.ros_types")
    else:
        single = names.use(PRIMITIVES[kind.base].__name__)
    limits = [] if kind.characters is None else [f"max_length={kind.characters}"]
    if not kind.is_array:
        return single, limits
    if not is_bytes(kind):
        single = f"{names.use('list')}[{_annotated(single, limits, names)}]"
    if kind.size is not None:
        return single, [f"min_length={kind.size}", f"max_length={kind.size}"]
    return single, [] if kind.bound is None else [f"max_length={kind.bound}"]


def _default(field: FieldDefinition, nested: str, names: _Names) -> str:
    plain = plain_default(field)
    renamed = [] if attribute(field.name) == field.name else [f"name={_literal(field.name)}"]
    if field.type.is_array and not is_bytes(field.type):
        if not plain and not renamed:
            return "[]"
        default = f"default_factory={_list_factory(plain, nested, names)}"
    elif nested:
        default = f"default_factory={nested}"
    elif renamed:
        default = f"default={_literal(plain)}"
    else:
        return _literal(plain)
    return f"{names.use('field', 'msgspec')}({', '.join([default, *renamed])})"


def _list_factory(items: list[Any], nested: str, names: _Names) -> str:
    if not items:
        return names.use("list")
    if nested:
        return f"lambda: [{nested}() for _ in {names.use('range')}({len(items)})]"
    if len(items) > 1 and all(item == items[0] for item in items):
        return f"lambda: [{_literal(items[0])}] * {len(items)}"
    return f"lambda: [{', '.join(map(_literal, items))}]"


def _literal(value: Any) -> str:
    if isinstance(value, str) and '"' not in value:
        return '"' + repr("'" + value)[2:]  # repr takes double quotes for text with a single one
    return repr(value)


def _fields(message: InterfaceMessage) -> Sequence[object]:
    """Return what two definitions of one message must have in common."""
    return [
        (field.name, field.type._replace(package=""), nested.type_name if nested else "")
        for field in message.definition.fields
        for nested in (message.nested.get(field.name),)
    ]


def _united(actions: Sequence[ActionFile]) -> list[ActionFile]:
    """Return the actions with class names that are unique among all their messages."""
    found = {one.type_name: one for action in actions for one in action.messages()}
    namesakes = Counter(one.definition.name for one in found.values())
    made: dict[str, InterfaceMessage] = {}

    def united(one: InterfaceMessage) -> InterfaceMessage:
        if one.type_name not in made:
            name = one.definition.name
            made[one.type_name] = one._replace(
                class_name=f"{one.package}_{name}" if namesakes[name] > 1 else name,
                nested={field: united(nested) for field, nested in one.nested.items()},
            )
        return made[one.type_name]

    return [
        action._replace(
            goal=united(action.goal),
            result=united(action.result),
            feedback=united(action.feedback),
        )
        for action in actions
    ]
