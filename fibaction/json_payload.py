"""JSON data to the payloads of an action and back, by the action's JSON Schemas.

With it, a program that has no Python types of an action can send goals that come from a form, a
file or another protocol. For example, with the description that a server sends of an action:

    from fibaction.json_payload import JsonCodec

    goals = JsonCodec(info.goal)
    payload = goals.encode({"order": 3})  # defaults are filled in

Checks by a schema need jsonschema: `pip install 'fibaction[json]'`. It is imported when the first
`JsonCodec` with a schema is made.
"""

from __future__ import annotations

import base64
import binascii
import copy
import datetime
import uuid
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, cast

import msgspec

from fibaction._json_errors import place, sentences
from fibaction._plain_data import is_list, is_map

__all__ = ["JsonCodec", "PayloadError", "to_json"]

Schema = dict[str, Any]

MAX_PROBLEMS = 5
"""Problems of one message that the text of an error names; later ones often follow from them."""

_FORMATS: dict[str, Any] = {
    "date-time": datetime.datetime,
    "date": datetime.date,
    "time": datetime.time,
    "duration": datetime.timedelta,
    "uuid": uuid.UUID,
}


class PayloadError(ValueError):
    """An error for data that is not a message of the expected type.

    The text is one sentence, which names the fields: `goal.order must be a whole number, not "x"`.
    """

    def __init__(self, *problems: str) -> None:
        more = len(problems) - MAX_PROBLEMS
        shown = [*problems[:MAX_PROBLEMS], *([f"and {more} more"] if more > 0 else [])]
        super().__init__("; ".join(shown))
        self.problems = problems
        """All problems, one sentence each, in the order of the fields."""


class JsonCodec:
    """A converter between JSON data and the payloads of one message type.

    In JSON data, bytes are base64 text, and times and durations are ISO 8601 text.
    """

    def __init__(self, schema: Mapping[str, Any], name: str = "goal") -> None:
        """Make a codec from a JSON Schema of `ActionInfo`. An empty schema allows any data.

        `name` is what errors call the message.
        """
        self._name = name
        self._schema: Schema = copy.deepcopy(dict(schema))
        self._definitions: Schema = self._schema.get("$defs", {})
        _close(self._schema)
        self._validator = _validator(self._schema) if schema else None

    def complete(self, data: Any) -> Any:
        """Return the message as plain data that can be sent, for example by an untyped client.

        Fields that are missing get their defaults, base64 text becomes bytes where the schema asks
        for bytes, and 3.0 becomes 3 where it asks for a whole number. `data` stays as it is; it may
        hold bytes already.

        Raises:
            PayloadError: The data does not match the schema, or has a field that it does not name.
        """
        if self._validator is None:
            return data
        self._as_in_json(data)  # fails for data that contains itself, before it is copied
        data = self._completed(data, self._schema)
        errors = sorted(self._validator.iter_errors(self._as_in_json(data)), key=place)
        # A validator reports each missing field by an error, whose sentences name all of them.
        problems = dict.fromkeys(text for error in errors for text in sentences(error, self._name))
        if problems:
            raise PayloadError(*problems)
        return self._converted(data, self._schema)

    def encode(self, data: Any) -> bytes:
        """Return the payload of a message; see `complete`.

        Raises:
            PayloadError: The data does not match the schema, or msgpack cannot express it.
        """
        message = self.complete(data)
        try:
            return msgspec.msgpack.encode(message)
        except (TypeError, ValueError, OverflowError, RecursionError) as exc:
            raise self._not_encoded(exc) from exc

    def decode(self, payload: bytes) -> Any:
        """Return the message in a payload as JSON data; see `to_json`.

        Raises:
            PayloadError: The payload is not msgpack, or JSON cannot express what it holds.
        """
        try:
            message = msgspec.msgpack.decode(payload)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as exc:
            raise PayloadError(f"the {self._name} is not a valid payload: {exc}") from exc
        return msgspec.json.decode(to_json(message))

    def _not_encoded(self, error: Exception) -> PayloadError:
        return PayloadError(f"the {self._name} cannot be encoded: {error}")

    def _as_in_json(self, data: Any) -> Any:
        """Return data with text in place of bytes, which is what a schema describes."""
        try:
            return msgspec.to_builtins(data, str_keys=True)
        except (TypeError, ValueError, RecursionError) as exc:
            raise self._not_encoded(exc) from exc

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
            return int(value)  # JSON Schema accepts 3.0 as a whole number, decoders do not
        return value

    def _resolved(self, schema: Schema, value: Any) -> Schema:
        """Return the schema of the value: behind references, and among alternatives."""
        while "$ref" in schema or "anyOf" in schema:
            if "$ref" in schema:
                schema = cast("Schema", self._definitions[schema["$ref"].rpartition("/")[2]])
            else:
                schema = self._chosen(schema["anyOf"], value)
        return schema

    def _chosen(self, parts: list[Schema], value: Any) -> Schema:
        plain = self._as_in_json(value)
        whole = ({**part, "$defs": self._definitions} for part in parts)
        return next((part for part in whole if _validator(part).is_valid(plain)), Schema())


def to_json(value: Any) -> str:
    """Return plain data, as an untyped client receives it, as JSON text on one line.

    Bytes become base64 text, times ISO 8601 text, NaN and infinities null, and an extension of
    msgpack a map of its code and its data.

    Raises:
        PayloadError: JSON cannot express the value.
    """
    try:
        return msgspec.json.encode(value, enc_hook=_without_extension).decode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise PayloadError(f"the value cannot be written as JSON: {exc}") from exc


def _without_extension(value: Any) -> Any:
    if isinstance(value, msgspec.msgpack.Ext):
        return {"ext": value.code, "data": value.data}
    raise TypeError(f"JSON has no {type(value).__name__}")


def _part(schema: Schema, keyword: str) -> Schema:
    """Return the schema of further items or fields; empty where the keyword is true or false."""
    part = schema.get(keyword)
    return cast("Schema", part) if isinstance(part, dict) else {}


def _close(schema: Schema) -> None:
    """Allow structs no fields but their own.

    A server may ignore unknown fields, but the author of one expects it to have an effect.
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


# The validator


def _validator(schema: Schema) -> Any:
    make, formats = _validator_class()
    return make(schema, format_checker=formats)


@cache
def _validator_class() -> tuple[Any, Any]:
    """Return a class of validators that also check base64, and the formats that they check."""
    from jsonschema import Draft202012Validator, FormatChecker, validators
    from jsonschema.exceptions import ValidationError

    def check_base64(_: Any, encoding: str, instance: Any, __: Any) -> Iterator[ValidationError]:
        if encoding == "base64" and isinstance(instance, str) and not _is_base64(instance):
            yield ValidationError("not base64")

    formats = FormatChecker(formats=())
    for name, kind in _FORMATS.items():
        formats.checks(name, raises=msgspec.ValidationError)(_format_check(kind))
    # The stub of jsonschema has no types for `extend`.
    extended = cast("Any", validators).extend(
        Draft202012Validator, {"contentEncoding": check_base64}
    )
    return extended, formats


def _is_base64(text: str) -> bool:
    try:
        base64.b64decode(text, validate=True)
    except binascii.Error:
        return False
    return True


def _format_check(kind: Any) -> Any:
    def check(value: Any) -> bool:
        if isinstance(value, str):
            msgspec.convert(value, kind)
        return True

    return check
