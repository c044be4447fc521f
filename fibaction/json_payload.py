"""JSON data to the payloads of an action and back, by the action's JSON Schemas."""

from fibaction.schema.payload import (
    JsonCodec,
    PayloadError,
    to_json,
)

__all__ = [
    "JsonCodec",
    "PayloadError",
    "to_json",
]
