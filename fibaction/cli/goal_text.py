"""A goal from YAML or JSON text, completed, and checked against the server's JSON Schema.

So a wrong goal is told of before it is sent, and by the name of the field. The schemas are those
that msgspec makes.
"""

from __future__ import annotations

import base64
import binascii
import copy
import datetime
import json
import re
import uuid
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, cast

import msgspec
import yaml
from jsonschema import Draft202012Validator, FormatChecker, validators
from jsonschema.exceptions import ValidationError

from fibaction.cli.exit_codes import ExitCode, Failure
from fibaction.cli.goal_errors import place_of, quoted, told
from fibaction.cli.output import is_list, is_map

Schema = dict[str, Any]

MOST_ERRORS = 5
"""How many errors of one goal are told of; the rest often follows from them."""

_FORMATS: dict[str, Any] = {
    "date-time": datetime.datetime,
    "date": datetime.date,
    "time": datetime.time,
    "duration": datetime.timedelta,
    "uuid": uuid.UUID,
}


def read_goal(text: str, schema: Schema) -> Any:
    """The goal as plain data, ready to be sent.

    What the text leaves out and the schema has a default for is filled in. An empty text is the
    goal `{}`. Bytes are written in base64, or as YAML's `!!binary`; times in ISO 8601.

    Raises:
        Failure: It is no YAML, or not what the schema asks for; the text names the field.
    """
    goal = _parsed(text)
    if not schema:
        return goal  # the server does not say what it wants
    _as_in_json(goal)  # which tells whether it ends at all
    shape = _Shape(schema)
    goal = shape.completed(goal)
    shape.check(goal)
    return shape.converted(goal)


# The text


class _Loader(yaml.SafeLoader):
    """YAML with numbers as people write them: `1e3` is one, which YAML 1.1 takes for text. Times
    stay text, since only the schema knows whether a time is meant.
    """

    yaml_implicit_resolvers = {  # noqa: RUF012  # PyYAML's attribute, and it has no type there
        first: [pair for pair in pairs if pair[0] != "tag:yaml.org,2002:timestamp"]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


cast("Any", _Loader).add_implicit_resolver(  # the stub has no types for it
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)[eE][-+]?\d+"),
    list("-+0123456789."),
)


def _parsed(text: str) -> Any:
    with suppress(ValueError, RecursionError):
        return json.loads(text)  # quicker, and JSON takes some text that YAML does not
    try:
        goal = yaml.load(text, _Loader)
        return {} if goal is None and yaml.compose(text, _Loader) is None else goal
    except yaml.MarkedYAMLError as exc:
        mark = exc.problem_mark or exc.context_mark
        where = f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
        problem = ", ".join(filter(None, (exc.context, exc.problem)))
        raise _unusable(f"the goal is no YAML{where}: {problem}") from exc
    except (yaml.YAMLError, ValueError, RecursionError) as exc:
        # A ValueError is of a number with too many digits, for instance.
        raise _unusable(f"the goal is no YAML: {exc}") from exc


def _unusable(text: str) -> Failure:
    return Failure(text, ExitCode.USAGE)


# The schema


class _Shape:
    """What a schema asks for."""

    def __init__(self, schema: Schema) -> None:
        self._schema = copy.deepcopy(schema)
        _close(self._schema)
        self._definitions: Schema = self._schema.get("$defs", {})
        self._validator = _Validator(self._schema, format_checker=_formats)

    def completed(self, goal: Any) -> Any:
        """The goal, with the defaults of what it leaves out."""
        return self._completed(goal, self._schema)

    def check(self, goal: Any) -> None:
        """Compare a goal with the schema.

        Raises:
            Failure: It is not what the schema asks for.
        """
        errors = sorted(self._validator.iter_errors(_as_in_json(goal)), key=place_of)
        # Missing fields come once for each of them, and each error tells of all.
        found = list(dict.fromkeys(text for error in errors for text in told(error)))
        if found:
            more = len(found) - MOST_ERRORS
            shown = found[:MOST_ERRORS] + ([f"and {more} more"] if more > 0 else [])
            raise _unusable("; ".join(shown))

    def converted(self, goal: Any) -> Any:
        """The goal as it is sent: with bytes instead of base64, and whole numbers as such."""
        return self._converted(goal, self._schema)

    def _completed(self, value: Any, schema: Schema) -> Any:
        schema = self._resolved(schema, value)
        if is_map(value) and "properties" in schema:
            whole: dict[Any, Any] = {}
            for name, part in schema["properties"].items():
                if name in value:
                    whole[name] = self._completed(value[name], part)
                elif "default" in part:
                    whole[name] = copy.deepcopy(part["default"])
            return {**whole, **{name: value[name] for name in value if name not in whole}}
        if is_list(value):
            rest = _part(schema, "items")
            return [self._completed(item, rest) for item in value]
        return value

    def _converted(self, value: Any, schema: Schema) -> Any:
        schema = self._resolved(schema, value)
        if is_map(value):
            known, rest = schema.get("properties", {}), _part(schema, "additionalProperties")
            return {name: self._converted(value[name], known.get(name, rest)) for name in value}
        if is_list(value):
            first, rest = schema.get("prefixItems", []), _part(schema, "items")
            parts = [*first, *[rest] * (len(value) - len(first))]
            return [self._converted(*pair) for pair in zip(value, parts, strict=False)]
        if isinstance(value, str) and schema.get("contentEncoding") == "base64":
            return base64.b64decode(value)
        if isinstance(value, float) and schema.get("type") == "integer":
            return int(value)  # JSON Schema takes 3.0 for a whole number, and decoders do not
        return value

    def _resolved(self, schema: Schema, value: Any) -> Schema:
        """The part of the schema that the value is of: behind references, among alternatives."""
        while "$ref" in schema or "anyOf" in schema:
            if "$ref" in schema:
                schema = cast("Schema", self._definitions[schema["$ref"].rpartition("/")[2]])
            else:
                schema = self._chosen(schema["anyOf"], value)
        return schema

    def _chosen(self, parts: list[Schema], value: Any) -> Schema:
        plain = _as_in_json(value)
        return next((part for part in parts if self._is_valid(plain, part)), Schema())

    def _is_valid(self, plain: Any, part: Schema) -> bool:
        whole = {**part, "$defs": self._definitions}
        return bool(_Validator(whole, format_checker=_formats).is_valid(plain))


def _as_in_json(value: Any) -> Any:
    """The value with text instead of bytes, as schemas speak of it."""
    try:
        return msgspec.to_builtins(value, str_keys=True)
    except (TypeError, ValueError, RecursionError) as exc:
        raise _unusable(f"the goal cannot be sent: {exc}") from exc


def _part(schema: Schema, keyword: str) -> Schema:
    """What a schema says of the rest of the items; it may be no schema, but true or false."""
    part = schema.get(keyword)
    return cast("Schema", part) if isinstance(part, dict) else {}


def _close(schema: Schema) -> None:
    """Let structs have no fields but their own. Servers may pass over those that they do not know,
    but who writes one means something by it.
    """
    if "properties" in schema:
        schema.setdefault("additionalProperties", False)
    for keyword in ("$defs", "properties"):
        for part in schema.get(keyword, {}).values():
            _close(part)
    for keyword in ("anyOf", "prefixItems"):
        for part in schema.get(keyword, ()):
            _close(part)
    for keyword in ("items", "additionalProperties"):
        if part := _part(schema, keyword):
            _close(part)


def _is_base64(_: Any, encoding: str, instance: Any, __: Any) -> Iterator[ValidationError]:
    if encoding == "base64" and isinstance(instance, str):
        try:
            base64.b64decode(instance, validate=True)
        except binascii.Error:
            yield ValidationError(f"{quoted(instance)} is no base64, which bytes are written in")


def _has_format(name: str) -> Any:
    def check(value: Any) -> bool:
        if isinstance(value, str):
            msgspec.convert(value, _FORMATS[name])
        return True

    return check


# The stub has no types for this either.
_Validator: Any = cast("Any", validators).extend(
    Draft202012Validator, {"contentEncoding": _is_base64}
)
_formats = FormatChecker(formats=())
for _name in _FORMATS:
    _formats.checks(_name, raises=msgspec.ValidationError)(_has_format(_name))
