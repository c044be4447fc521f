"""The JSON Schema of a type of msgspec, with what msgspec leaves out.

- The defaults of fields that a function makes, since it may return another value each time. But a
  client that does not know a default cannot show what the server will get. So the function is
  called twice: what it returns both times is the default, and what differs, such as a random ID, is
  left to the server.
- The descriptions of fields that are plain text: `Annotated[int, "How far."]`.
- The formats of times that may be without an offset from UTC, so that a form shows a picker, and
  the check names the field. `iso-date-time` and `iso-time`, with an offset or without, are names of
  `ajv-formats`; `date-time-local` is one of the OpenAPI registry.

A path of `pathlib` is text in a message, and has the format `path`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from inspect import cleandoc
from pathlib import PurePath
from typing import Any, cast, get_origin, get_type_hints

import msgspec
from msgspec import inspect

from fibaction.words.plain_data import is_map


def schema_of(
    message_type: Any, describe: Callable[[type], dict[str, Any]] | None = None
) -> dict[str, Any]:
    """Return the JSON Schema of a type. `describe` is a `schema_hook`.

    Raises:
        TypeError: JSON Schema cannot describe the type.
    """
    info = inspect.type_info(message_type)
    objects = list(_objects(info, set()))
    types = [message_type, *(kind.cls for kind in objects)]
    (schema, *references), parts = msgspec.json.schema_components(
        types, schema_hook=describe, ref_template="#/$defs/{name}"
    )
    for kind, reference in zip(objects, references, strict=True):
        _, _, name = reference["$ref"].rpartition("/")
        _add_defaults(parts[name], kind.fields)
        _add_descriptions(parts[name], kind)
        known = parts[name].get("properties", {})
        for field in kind.fields:
            _add_formats(known.get(field.encode_name), field.type)
    _add_formats(schema, info)
    return {**schema, "$defs": parts} if parts else schema


def _add_defaults(part: dict[str, Any], fields: tuple[inspect.Field, ...]) -> None:
    """Add the defaults that functions make to the schema of a type with fields."""
    known = part.get("properties", {})
    for field in fields:
        shown = known.get(field.encode_name)
        if field.default_factory is msgspec.NODEFAULT or not is_map(shown) or "default" in shown:
            continue
        default = constant_of(field.default_factory)
        if default is not msgspec.NODEFAULT:
            shown["default"] = default


def _add_descriptions(part: dict[str, Any], kind: Any) -> None:
    """Add the descriptions that msgspec does not see to the schema of a type with fields."""
    cls: Any = get_origin(kind.cls) or kind.cls
    if "description" in part:  # a docstring, whose indent depends on the Python
        part["description"] = cleandoc(cls.__doc__)
    hints: dict[str, Any] = {}
    with suppress(NameError, TypeError):  # names that only msgspec finds
        hints = get_type_hints(cls, include_extras=True)
    known = part.get("properties", {})
    for field in kind.fields:
        shown = known.get(field.encode_name)
        hint = hints.get(field.name)
        texts = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, str)]
        if texts and is_map(shown):
            shown.setdefault("description", texts[0])


def _add_formats(part: Any, kind: inspect.Type) -> None:
    """Add the formats of times to the schema of a type, but for types with fields in it."""
    while isinstance(kind, inspect.Metadata):
        kind = kind.type
    if not is_map(part):
        return
    match kind:
        case inspect.DateTimeType():
            local = "iso-date-time" if kind.tz is None else "date-time-local"
            part.setdefault("format", local)
        case inspect.TimeType():
            part.setdefault("format", "iso-time")
        case inspect.CollectionType():
            _add_formats(part.get("items"), kind.item_type)
        case inspect.DictType():
            _add_formats(part.get("additionalProperties"), kind.value_type)
        case inspect.TupleType():
            for one, inner in zip(part.get("prefixItems", ()), kind.item_types, strict=False):
                _add_formats(one, inner)
        case inspect.UnionType():
            # Before types with fields, and null, which msgspec moves to the end.
            for one, inner in zip(part.get("anyOf", ()), _others_in(kind), strict=False):
                _add_formats(one, inner)
        case _:
            pass


def _others_in(kind: inspect.UnionType) -> Iterator[inspect.Type]:
    for one in kind.types:
        bare = one.type if isinstance(one, inspect.Metadata) else one
        has_fields = isinstance(bare, inspect.StructType) and not bare.array_like
        if not (has_fields or isinstance(bare, inspect.NoneType)):
            yield one


def constant_of(factory: Any, plain: Callable[[Any], Any] | None = None) -> Any:
    """Return what a function without parameters returns each time, as JSON data; NODEFAULT if its
    values differ, it has an error, or JSON cannot express them. `plain` is an `enc_hook`.
    """
    try:
        hook = plain or plain_path
        first, second = (msgspec.json.encode(factory(), enc_hook=hook) for _ in range(2))
    except Exception:  # any: the server will meet it, too, and tell it there
        return msgspec.NODEFAULT
    return msgspec.json.decode(first) if first == second else msgspec.NODEFAULT


def plain_path(value: object) -> str:
    """Return a path as text: the `enc_hook` of types without classes of other libraries.

    Raises:
        TypeError: It is not a path.
    """
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"Encoding objects of type {type(value).__name__} is unsupported")


def _objects(info: object, seen: set[object]) -> Iterator[Any]:
    """Yield the types with fields in a type, each once."""
    if isinstance(info, tuple):
        for item in cast("tuple[object, ...]", info):
            yield from _objects(item, seen)
    elif isinstance(info, inspect.Field):
        yield from _objects(info.type, seen)
    elif isinstance(info, inspect.Type):
        if isinstance(info, _WITH_FIELDS):
            if info.cls in seen:
                return
            seen.add(info.cls)
            yield info
        for name in info.__struct_fields__:
            yield from _objects(getattr(info, name), seen)


_WITH_FIELDS = (
    inspect.StructType,
    inspect.DataclassType,
    inspect.TypedDictType,
    inspect.NamedTupleType,
)


def is_path_class(kind: Any) -> bool:
    """Return whether a class is one of `pathlib`."""
    return isinstance(kind, type) and issubclass(kind, PurePath)


def path_of(kind: Any, data: Any) -> Any:
    """Make a path of its text; data of the type `object` stay as they are.

    Raises:
        ValueError: The data are not text; msgspec adds where they are.
    """
    if not is_path_class(kind):
        return data
    if not isinstance(data, str):
        raise ValueError(f"Expected `str`, got `{type(data).__name__}`")
    return kind(data)


def path_schema(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a path; of another class, none."""
    if not is_path_class(kind):
        raise NotImplementedError
    return {"type": "string", "format": "path"}
