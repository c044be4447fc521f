"""Goals of rosbridge clients: their arguments as a payload, by the schema of the action.

A message of ROS is an object. An action of fibaction may have other types, for example a number:
these are `{"data": value}` here, like the messages of `std_msgs`.
"""

from __future__ import annotations

from typing import Any

from fibaction.schema.json_schema import JsonSchema
from fibaction.schema.payload import GoalCodec, JsonCodec, PayloadError
from fibaction.schema.turns import Pause
from fibaction.types.action import ActionInfo
from fibaction.words.plain_data import is_map
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
