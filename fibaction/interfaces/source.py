"""The messages of an action as the source of a Python module, for type checkers and for reading.

The classes are those that `fibaction.interfaces.structs` makes, with the same JSON Schemas. It is
laid out as ruff does it with lines of 88 columns, which is what ruff has unless told otherwise.
"""

from __future__ import annotations

import re
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import Any

from fibaction.interfaces.definitions import Constant, Field, FieldType
from fibaction.interfaces.files import ActionFile, Message
from fibaction.interfaces.layout import (
    WIDTH,
    Group,
    Node,
    Text,
    broken,
    flat,
    laid_out,
    quoted,
    requoted,
)
from fibaction.interfaces.structs import docstring, is_bytes, plain_default
from fibaction.ros_types import PRIMITIVES, attribute

_STANDARD = ("builtins", "typing")
_LIMITED = {
    name: name.title().replace("Ui", "UI")
    for name, kind in PRIMITIVES.items()
    if not isinstance(kind, type)
}
"""The names in `fibaction.ros_types` of those primitives that have limits."""


class _Names:
    """The names that the module imports, each called otherwise where that name is taken.

    No name in an interface file ends with `_`, so that makes another one.
    """

    def __init__(self, taken: Iterable[str]) -> None:
        self._taken = frozenset(taken)
        self._used: defaultdict[str, set[str]] = defaultdict(set)

    def use(self, name: str, module: str = "builtins") -> str:
        called = f"{name}_" if name in self._taken else name
        if module != "builtins" or called != name:
            self._used[module].add(name if called == name else f"{name} as {called}")
        return called

    def lines(self) -> Iterator[str]:
        """The imports, as isort has them."""
        blocks: list[list[str]] = [[], []]
        for module in sorted(self._used):
            names = sorted(self._used[module], key=_isort_key)
            together = [name for name in names if " as " not in name]
            block = blocks[module not in _STANDARD]
            if together:
                start = f"from {module} import "
                line = start + ", ".join(together)
                group = Group(f"{start}(", list(together), ")")
                block += [line] if len(line) <= WIDTH else broken("", group, "", 0)
            block += [f"from {module} import {name}" for name in names if " as " in name]
        for block in filter(None, blocks):
            yield from block
            yield ""


def _isort_key(name: str) -> tuple[bool, list[str | int]]:
    """Classes before functions, and Int8 before Int16."""
    parts = re.split(r"(\d+)", name)
    return name[0].islower(), [int(part) if part.isdigit() else part for part in parts]


def python_source(action: ActionFile) -> str:
    """The source of a module with a class for each message, and the action.

    The action is a constant with its name in capitals.
    """
    messages = action.messages()
    constant = re.sub(r"\W+", "_", action.name).strip("_").upper()
    names = _Names(_names_in(messages))
    classes = [line for message in messages for line in ("", "", *_class(message, names))]
    made = Group(
        f"{names.use('Action', 'fibaction')}(",
        [
            quoted(action.name),
            *(
                f"{part}={message.class_name}"
                for part, message in (
                    ("goal", action.goal),
                    ("feedback", action.feedback),
                    ("result", action.result),
                )
            ),
            *([f"type_name={quoted(action.type_name)}"] if action.type_name else []),
        ],
        ")",
    )
    if constant in {message.class_name for message in messages}:
        constant += "_"
    about = action.type_name or action.path.stem
    lines = [
        f'"""The messages of `{about}`.',
        "",
        f"Written by `fibaction gen` from {action.path.name}.",
        "Change that file, not this one.",
        '"""',
        "",
        *names.lines(),
    ]
    lines[-1:] = [*classes, "", "", *laid_out(f"{constant} = ", made, "", 0)]
    return "\n".join(lines) + "\n"


def _names_in(messages: Iterable[Message]) -> Iterator[str]:
    for message in messages:
        yield message.class_name
        for field in message.definition.fields:
            yield field.name
        for constant in message.definition.constants:
            yield constant.name


def _class(message: Message, names: _Names) -> Iterator[str]:
    struct = names.use("Struct", "msgspec")
    head = Group(
        f"class {message.class_name}(", [struct, "forbid_unknown_fields=True", "kw_only=True"], "):"
    )
    yield from laid_out("", head, "", 0)
    yield from _docstring(docstring(message))
    if message.definition.constants:
        yield ""
    for constant in message.definition.constants:
        yield from _constant(constant, names)
    if message.definition.fields:
        yield ""
    for field in message.definition.fields:
        nested = message.nested.get(field.name)
        yield from _field(field, nested.class_name if nested else "", names)


def _docstring(text: str) -> Iterator[str]:
    raw = ""
    if "\\" in text and not text.endswith("\\") and '"""' not in text and text[-1] != '"':
        raw = "r"
    else:
        text = text.replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
        text = re.sub(r'(?<!\\)"$', r"\"", text)
    first, *more = text.split("\n")
    if not more and len(first) + len(raw) <= WIDTH - 10:
        yield f'    {raw}"""{first}"""'
        return
    yield f'    {raw}"""{first}'
    for line in more:
        yield f"    {line}".rstrip()
    yield '    """'


def _constant(constant: Constant, names: _Names) -> Iterator[str]:
    for line in constant.comment.splitlines():
        yield from textwrap.wrap(
            line, WIDTH, initial_indent="    # ", subsequent_indent="    # "
        ) or ["    #"]
    kind = names.use(type(constant.value).__name__)
    before = f"{constant.name}: {names.use('ClassVar', 'typing')}[{kind}] = "
    yield from laid_out(before, _value(constant.value), "", 4)


def _field(field: Field, nested: str, names: _Names) -> Iterator[str]:
    name = attribute(field.name)
    kind = _annotation(field, nested, names)
    default = _default(field, nested, names)
    together = laid_out(f"{name}: {flat(kind)} = ", default, "", 4)
    if len(together[0]) <= WIDTH or not isinstance(kind, Group):
        yield from together
        return
    *lines, last = broken(f"{name}: ", kind, "", 4)
    yield from lines
    yield from laid_out(f"{last.strip()} = ", default, "", 4)


def _annotation(field: Field, nested: str, names: _Names) -> Node:
    kind, extra = _type_of(field.type, nested, names)
    if field.comment:
        extra = [*extra, Text("description=", field.comment)]
    if not extra:
        return kind
    annotated = f"{names.use('Annotated', 'typing')}["
    return Group(annotated, [kind, Group(f"{names.use('Meta', 'msgspec')}(", extra, ")")], "]")


def _type_of(kind: FieldType, nested: str, names: _Names) -> tuple[str, list[Node]]:
    """A type, and what its limits are."""
    extra: list[Node] = []
    if is_bytes(kind):
        single = names.use("bytes")
    elif nested:
        single = nested
    elif kind.base in _LIMITED:
        single = names.use(_LIMITED[kind.base], "fibaction.ros_types")
    else:
        single = names.use(PRIMITIVES[kind.base].__name__)
    if kind.characters is not None:
        extra = [f"max_length={kind.characters}"]
    if not kind.is_array:
        return single, extra
    if extra:
        annotated, meta = names.use("Annotated", "typing"), names.use("Meta", "msgspec")
        single = f"{annotated}[{single}, {meta}({flat(extra[0])})]"
    if not is_bytes(kind):
        single = f"{names.use('list')}[{single}]"
    if kind.size is not None:
        return single, [f"min_length={kind.size}", f"max_length={kind.size}"]
    return single, [] if kind.bound is None else [f"max_length={kind.bound}"]


def _default(field: Field, nested: str, names: _Names) -> Node:
    plain = plain_default(field)
    renamed = [] if attribute(field.name) == field.name else [f"name={quoted(field.name)}"]
    factory: Node
    if field.type.is_array and not is_bytes(field.type):
        if not plain and not renamed:
            return "[]"
        factory = _list_factory(plain, nested, names)
    elif nested:
        factory = f"default_factory={nested}"
    elif renamed:
        factory = f"default={flat(_value(plain))}"
    else:
        return _value(plain)
    return Group(f"{names.use('field', 'msgspec')}(", [factory, *renamed], ")")


def _list_factory(items: list[Any], nested: str, names: _Names) -> Node:
    if not items:
        return f"default_factory={names.use('list')}"
    before = "default_factory=lambda: ["
    if nested:
        return f"{before}{nested}() for _ in {names.use('range')}({len(items)})]"
    if len(items) > 1 and all(item == items[0] for item in items):
        return f"{before}{flat(_value(items[0]))}] * {len(items)}"
    return Group(before, [_value(item) for item in items], "]")


def _value(value: Any) -> Node:
    if isinstance(value, str):
        return Text("", value)
    if isinstance(value, bytes):
        return f"b{requoted(repr(value)[1:])}"
    return repr(value).replace("e+", "e")
