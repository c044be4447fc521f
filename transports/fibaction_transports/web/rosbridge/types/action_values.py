"""Conversion of the messages of an action between rosbridge and payloads.

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

from fibaction.schema.json_schema import JsonSchema
from fibaction.schema.payload import JsonCodec, PayloadError, to_json
from fibaction.types.action import NIL, ActionInfo
from fibaction.words.plain_data import is_list, is_map
from fibaction_transports.web.rosbridge.types.goal_arguments import (
    DATA,
    fields_of,
    object_text,
    target_of,
    values_text,
)

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
