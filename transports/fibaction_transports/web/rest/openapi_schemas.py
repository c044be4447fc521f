"""The schemas of an OpenAPI description: those of each action, moved to where they are shared.

In a description, the schemas of all actions lie side by side, and a generator of clients makes one
class of each. So definitions move up and get names of their own, which stay different when a
generator leaves out punctuation and capitals; references and discriminators follow. Titles would
again be names of classes, and equal ones, so the shared schemas have none.

The rules that a server checks beyond its schema are added to goals: a field that is not known is
rejected, whole numbers have 64 bits at most, bytes are base64 text, and formats that others do not
know have a pattern. Each goal has an example, which is the template of the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias
from urllib.parse import unquote

import msgspec

from fibaction.schema.template import Template
from fibaction.words.plain_data import is_list, is_map

Json: TypeAlias = dict[str, Any]

BASE64 = "^(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?$"
_DAY = (
    "(?!0000)(?:[0-9]{4}-(?:(?:0[13578]|1[02])-(?:0[1-9]|[12][0-9]|3[01])|(?:0[469]|11)-(?:0[1-9]|"
    "[12][0-9]|30)|02-(?:0[1-9]|1[0-9]|2[0-8]))|(?:[0-9]{2}(?:0[48]|[2468][048]|[13579][26])|"
    "(?:[02468][048]|[13579][26])00)-02-29)"
)
_HOURS = "(?:[01][0-9]|2[0-3]):[0-5][0-9]:[0-5][0-9](?:[.][0-9]{1,9})?"
_OFFSET = "(?:[Zz]|[-+](?:[01][0-9]|2[0-3]):?[0-5][0-9])?"
_CLOCK = "T(?=[0-9])(?:[0-9]{1,8}H)?(?:[0-9]{1,8}M)?(?:[0-9]{1,8}(?:[.][0-9]{1,9})?S)?"
PATTERNS = {
    "iso-date-time": f"^{_DAY}[Tt ]{_HOURS}{_OFFSET}$",
    "date-time-local": f"^{_DAY}[Tt ]{_HOURS}$",
    "iso-time": f"^{_HOURS}{_OFFSET}$",
    "partial-time": f"^{_HOURS}$",
    "iso-duration": f"^[-+]?P(?:[0-9]{{1,8}}D(?:{_CLOCK})?|{_CLOCK})$",
    "decimal": "^[-+]?(?:(?:[0-9]+[.]?[0-9]*|[.][0-9]+)(?:[eE][-+]?[0-9]{1,9})?|NaN|Infinity)$",
}
"""The texts of formats that are not those of JSON Schema."""
SHARED = "#/components/schemas/"
LARGEST_EXAMPLE = 20_000
"""Parts and characters of the goal that is an example."""

_DATA = frozenset({"const", "default", "enum", "example", "examples", "required"})
_ANNOTATIONS = frozenset({"default", "deprecated", "description", "examples", "title"})
_BY_NAME = frozenset({"$defs", "dependentSchemas", "patternProperties", "properties"})
_COMBINED = frozenset({"allOf", "dependentSchemas", "if", "not", "patternProperties"})
_CHOICES = frozenset({"$ref", "anyOf", "oneOf"})
_LOCAL = "#/$defs/"


def of_structs(*kinds: type[msgspec.Struct]) -> Json:
    """Return the schemas of structs of our own, by their names."""
    _, schemas = msgspec.json.schema_components(kinds, ref_template=SHARED + "{name}")
    for schema in schemas.values():
        del schema["title"]
    return schemas


class Names:
    """Names that stay different without punctuation and capitals."""

    def __init__(self, *taken: str) -> None:
        self._taken = set(map(_plain, taken))

    def unique(self, wanted: str) -> str:
        """Return a name that is like the wanted one, and like no other one before."""
        name = wanted = re.sub(r"[^A-Za-z0-9_]+", ".", wanted)
        number = 1
        while _plain(name) in self._taken:
            number += 1
            name = f"{wanted}.{number}"
        self._taken.add(_plain(name))
        return name


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def moved(schema: Json, name: str, names: Names, *, is_goal: bool = False) -> Json:
    """Return the shared schemas that a schema becomes, by their names; `name` is its own.

    A schema that is nested too deep becomes one that allows any value.
    """
    try:
        parts = _Parts(schema, name, names)
        found = {parts.names[key]: parts.moved(part) for key, part in parts.definitions.items()}
        found[name] = parts.moved(parts.root)
        if is_goal and not any(map(_is_combined, _parts_of(list(found.values())))):
            found = {key: _changed(part, _closed) for key, part in found.items()}
        if is_goal:
            found = {key: _changed(part, _limited) for key, part in found.items()}
        found = {key: _changed(part, _without_object_default) for key, part in found.items()}
    except RecursionError:
        return {name: {}}
    return found


def example_of(schema: Json) -> Json:
    """Return the field of a body with a goal to begin with; empty if the goal would be large.

    A default may be that of many fields, so a small schema may have a very large template.
    """
    template = Template(schema)
    left = LARGEST_EXAMPLE if template.is_usable else 0
    todo: list[Any] = [template.value]
    while todo and left > 0:
        part = todo.pop()
        inner = list(part.values()) if is_map(part) else part if is_list(part) else []
        left -= 1 + len(inner) + (len(part) if isinstance(part, str) else 0)
        if left > 0:
            todo += inner
    return {"example": template.value} if left > 0 else {}


class _Parts:
    """A schema that is moved: its root, its definitions, and their new names."""

    def __init__(self, schema: Json, name: str, names: Names) -> None:
        definitions = schema.get("$defs", {})
        self.root: Json = {key: part for key, part in schema.items() if key != "$defs"}
        self.definitions: Json = dict(definitions) if is_map(definitions) else {}
        self._name = name
        self.names: dict[str, str] = {}
        key = _key_of(self.root.get("$ref"))
        said = {word: part for word, part in self.root.items() if word != "$ref"}
        is_name = self.root.get("$ref") == _LOCAL + key and said.keys() <= _ANNOTATIONS
        if is_name and is_map(self.definitions.get(key)):
            # A generator makes nothing of a name for a name.
            self.root = self.definitions.pop(key) | said
            self.names[key] = name
        for key in self.definitions:
            self.names[key] = names.unique(f"{name}.{key}")

    def moved(self, part: Any) -> Any:
        """Return a schema with its references pointing to where the definitions are now."""
        changed = _changed(part, self._redirected)
        if is_map(changed):
            changed.pop("title", None)
        return changed

    def _redirected(self, part: Json) -> Json:
        if "$ref" in part:
            reference = self._reference(part.pop("$ref"))
            if reference:
                part["$ref"] = reference
        if part.get("format") == "duration":  # of JSON Schema: without a sign and fractions
            part["format"] = "iso-duration"
        discriminator = part.get("discriminator")
        if is_map(discriminator) and is_map(mapping := discriminator.get("mapping")):
            found = {key: self._reference(value) for key, value in mapping.items()}
            known = {str(key): value for key, value in found.items() if value}
            part["discriminator"] = discriminator | {"mapping": known}
        return part

    def _reference(self, reference: object) -> str:
        """Return where a reference leads now; empty if it leads nowhere in this schema."""
        if reference == "#":
            return SHARED + self._name
        key = _key_of(reference)
        if key not in self.names:
            return ""
        below = str(reference).removeprefix(_LOCAL).partition("/")[2]
        return SHARED + self.names[key] + (f"/{below}" if below else "")


def _key_of(reference: object) -> str:
    """Return the name of the definition that a reference leads to or into; empty for others."""
    if not isinstance(reference, str) or not reference.startswith(_LOCAL):
        return ""
    key = unquote(reference.removeprefix(_LOCAL).partition("/")[0])
    return key.replace("~1", "/").replace("~0", "~")


def _parts_of(part: Any) -> Iterator[Json]:
    """Yield all maps in a schema."""
    if is_map(part):
        yield part
        for item in part.values():
            yield from _parts_of(item)
    elif is_list(part):
        for item in part:
            yield from _parts_of(item)


def _changed(part: Any, change: Callable[[Json], Json]) -> Any:
    """Return a copy of a schema in which each schema was changed, the innermost ones first."""
    if is_list(part):
        return [_changed(item, change) for item in part]
    if not is_map(part):
        return part
    copy: Json = {}
    for key, item in part.items():
        if key in _DATA:
            copy[key] = item
        elif key in _BY_NAME and is_map(item):
            copy[key] = {name: _changed(schema, change) for name, schema in item.items()}
        else:
            copy[key] = _changed(item, change)
    return change(copy)


def _is_combined(part: Json) -> bool:
    """Return whether other schemas may describe more fields than this one, or a part of it."""
    return not _COMBINED.isdisjoint(part) or (
        "properties" in part and not _CHOICES.isdisjoint(part)
    )


def _closed(part: Json) -> Json:
    if "properties" in part:
        part.setdefault("additionalProperties", False)
    return part


def _without_object_default(part: Json) -> Json:
    """Leave out a default that is an object: openapi-python-client 0.29 takes none, and leaves out
    the operations that need it. The field stays one that may be missing.
    """
    if is_map(part.get("default")):
        del part["default"]
    return part


def _limited(part: Json) -> Json:
    if part.get("type") == "integer":
        if "exclusiveMinimum" not in part:
            part.setdefault("minimum", -(2**63))
        if "exclusiveMaximum" not in part:
            part.setdefault("maximum", 2**64 - 1)
    if part.get("contentEncoding") == "base64":
        part.setdefault("pattern", BASE64)
    if (pattern := PATTERNS.get(str(part.get("format")))) is not None:
        part.setdefault("pattern", pattern)
    return part
