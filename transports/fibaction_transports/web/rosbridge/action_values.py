"""Conversion of the messages of an action between rosbridge and payloads.

A message of ROS is an object. An action of fibaction may have other types, for example a number:
these are `{"data": value}` here, like the messages of `std_msgs`.

A rosbridge server takes the bytes of a goal as a list of numbers, whatever array of ROS they are;
base64 text only for a `uint8[]`. It writes both, which become bytes where the schema has them.

JSON has no NaN and no infinities: a rosbridge server writes `null` for them, and takes none. So
`null` becomes NaN where the schema has a number, and a goal with such a number is not sent.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import msgspec

from fibaction.schema.check import JsonSchema
from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError, to_json
from fibaction.schema.turns import Pause
from fibaction.types.action import NIL, ActionInfo
from fibaction.words.plain_data import is_list, is_map
from fibaction_transports.web.rosbridge.operations import Arguments

DATA = "data"
"""The field of a message that is not an object."""

_any = JsonCodec({}, "message")


def values_text(payload: bytes) -> str:
    """Return a message of an action as JSON text, which is an object.

    Raises:
        PayloadError: JSON cannot express it.
    """
    return object_text(_any.to_text(payload))


def object_text(text: str) -> str:
    """Return the JSON text of an object with a value in it; that of an object as it is."""
    return text if text.startswith("{") else f'{{"{DATA}":{text}}}'


class GoalArguments:
    """The arguments of the goals of one action."""

    def __init__(self, info: ActionInfo) -> None:
        """Read the schema.

        Raises:
            PayloadError: It cannot be used.
        """
        self.info = info
        self._codec = GoalCodec(info.goal)
        self._fields = fields_of(info.goal)

    def encode(self, args: Arguments, pause: Pause | None = None) -> bytes:
        """Return the payload of a goal; see `JsonCodec.encode`.

        Raises:
            PayloadError: The arguments do not match the schema.
        """
        return self._codec.encode(self._data(args), is_json=True, pause=pause)

    def _data(self, args: Arguments) -> Any:
        if self._fields is None:
            has_data = isinstance(args, dict) and set(args) == {DATA} and self.info.goal
            return args[DATA] if has_data and isinstance(args, dict) else args
        if not isinstance(args, list):
            return args or {}
        if len(args) > len(self._fields):
            raise PayloadError(
                f"the goal has {len(self._fields)} fields, and {len(args)} are given"
            )
        return dict(zip(self._fields, args, strict=False))


def fields_of(schema: dict[str, Any]) -> list[str] | None:
    """Return the names of the fields of a message, in their order; None if it is not an object.

    Raises:
        SchemaError: The schema cannot be used.
    """
    root = target_of(JsonSchema(schema), schema)
    return list(root["properties"]) if is_map(root) and "properties" in root else None


def target_of(schema: JsonSchema, part: Any) -> Any:
    """Return the schema that a part of it is, behind references.

    Raises:
        SchemaError: It refers to something outside.
    """
    while is_map(part) and "$ref" in part:
        part = schema.target(part["$ref"])
    return part


LONGEST_LIST = 2**16
"""Bytes that a goal has as a list of numbers, which takes nearly three times the space of base64
text. A `uint8[]` of ROS that is longer has base64 text; other arrays are shorter in practice."""


def arguments_text(goal: bytes) -> str:
    """Return the payload of a goal as the JSON text of its arguments.

    Raises:
        PayloadError: JSON cannot express it.
    """
    if goal == NIL:
        return "{}"
    text = values_text(goal)
    message = msgspec.msgpack.decode(goal)
    try:
        if "null" in text and _has_special_float(message):
            raise PayloadError(
                "the goal has a number that is NaN or infinite, which rosbridge cannot carry"
            )
        return object_text(to_json(_with_lists(message)))
    except RecursionError as exc:
        raise PayloadError("the goal is nested too deeply") from exc


def _has_special_float(value: Any) -> bool:
    if isinstance(value, float):
        return not math.isfinite(value)
    if is_map(value):
        return any(map(_has_special_float, value.values()))
    return is_list(value) and any(map(_has_special_float, value))


def _with_lists(value: Any) -> Any:
    """Return a message with lists of numbers in place of bytes that are not too long for it."""
    if isinstance(value, bytes):
        return list(value) if len(value) <= LONGEST_LIST else value
    if is_map(value):
        return {name: _with_lists(item) for name, item in value.items()}
    return list(map(_with_lists, value)) if is_list(value) else value


class MessageValues:
    """The values of one message of an action."""

    def __init__(self, schema: dict[str, Any], name: str) -> None:
        """Read the schema; `name` is what errors call the message.

        Raises:
            PayloadError: The schema cannot be used.
        """
        self._codec = JsonCodec(schema, name)
        self._schema = JsonSchema(schema)
        self._is_bare = bool(schema) and fields_of(schema) is None

    def encode(self, values: Any) -> bytes:
        """Return the payload of a message.

        Raises:
            PayloadError: The values do not match the schema.
        """
        if self._is_bare and is_map(values) and set(values) == {DATA}:
            values = values[DATA]
        try:
            return self._codec.encode(self._with_nans(values, self._schema.root))
        except RecursionError as exc:
            raise PayloadError("the values are nested too deeply") from exc

    def _with_nans(self, value: Any, part: Any) -> Any:
        part = target_of(self._schema, part)
        if not is_map(part):
            return value
        if value is None and part.get("type") == "number":
            return math.nan
        if is_map(value):
            fields = part.get("properties", {})
            return {name: self._with_nans(value[name], fields.get(name)) for name in value}
        if is_list(value):
            return [self._with_nans(item, part.get("items")) for item in value]
        return value


class ActionValues:
    """The values of the feedback and the results of one action."""

    def __init__(self, info: ActionInfo) -> None:
        """Read the schemas.

        Raises:
            PayloadError: One of them cannot be used.
        """
        self.feedback = MessageValues(info.feedback, "feedback")
        self._result = MessageValues(info.result, "result")
        self._empty: bytes | None = None
        with suppress(PayloadError):  # a result may have fields without defaults
            self._empty = self._result.encode({})

    def result(self, values: Any) -> bytes:
        """Return the payload of the result of a goal that has succeeded.

        Raises:
            PayloadError: The values do not match the schema.
        """
        return self._result.encode({} if values is None else values)

    def partial_result(self, values: Any) -> bytes | None:
        """Return the payload of the result of a goal that was aborted or canceled; None if it is
        empty, since ROS cannot send "no result".

        Raises:
            PayloadError: The values do not match the schema.
        """
        if values is None or values == {}:
            return None
        payload = self._result.encode(values)
        return None if payload == self._empty else payload
