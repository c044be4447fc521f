"""Values between JSON data and the messages of A2A, whose numbers are 64-bit floats.

A whole number beyond 2**53 cannot be carried exactly. So one that is sent to an agent becomes text,
as protobuf writes such numbers, and a goal that has one is rejected.
"""

from __future__ import annotations

import math
from typing import Any

from a2a.types import Part
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.struct_pb2 import Struct, Value

from fibaction.schema.payload import JsonCodec, PayloadError, to_json
from fibaction.words.plain_data import is_list, is_map

LARGEST = 2**53
"""The largest whole number up to which floats have all of them."""


def data_part(codec: JsonCodec, payload: bytes) -> Part:
    """Return a payload as a part with data; as a part with text if A2A cannot carry it as data."""
    try:
        data = codec.decode(payload)
    except PayloadError as exc:
        return Part(text=f"the message cannot be shown: {exc}")
    try:
        return Part(data=ParseDict(_exact(data), Value()), media_type="application/json")
    except ParseError:  # it nests too deep
        return Part(text=to_json(data), media_type="application/json")


def struct_of(data: dict[str, Any]) -> Struct:
    """Return metadata as a message."""
    struct = Struct()
    struct.update(_exact(data))
    return struct


def plain_of(value: Value) -> Any:
    """Return a value as plain data; a whole number is an integer if that is exact.

    Raises:
        ValueError: A number is not finite.
    """
    kind = value.WhichOneof("kind")
    if kind == "struct_value":
        return {name: plain_of(one) for name, one in value.struct_value.fields.items()}
    if kind == "list_value":
        return [plain_of(one) for one in value.list_value.values]
    if kind == "number_value":
        number = value.number_value
        if not math.isfinite(number):
            raise ValueError("a number is not finite")
        return int(number) if number.is_integer() and abs(number) <= LARGEST else number
    return {"string_value": value.string_value, "bool_value": value.bool_value}.get(kind or "")


def has_inexact(data: Any) -> bool:
    """Return whether plain data has a whole number that A2A cannot have carried exactly."""
    if is_map(data):
        return any(map(has_inexact, data.values()))
    if is_list(data):
        return any(map(has_inexact, data))
    return isinstance(data, int) and abs(data) >= LARGEST


def _exact(data: Any) -> Any:
    if is_map(data):
        return {name: _exact(one) for name, one in data.items()}
    if is_list(data):
        return [_exact(one) for one in data]
    if isinstance(data, int) and not isinstance(data, bool) and abs(data) > LARGEST:
        return str(data)
    return data
