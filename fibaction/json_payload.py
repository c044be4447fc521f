"""JSON data to the payloads of an action and back, by the action's JSON Schemas."""

from fibaction.schema.payload import (
    MAX_PARTS,
    JsonCodec,
    JsonSchema,
    PayloadError,
    SchemaError,
    to_json,
)

__all__ = [
    "MAX_PARTS",
    "JsonCodec",
    "JsonSchema",
    "PayloadError",
    "SchemaError",
    "to_json",
]
