"""Values between JSON data and the messages of A2A, whose numbers are 64-bit floats.

A whole number beyond 2**53 cannot be carried exactly. So one that is sent to an agent becomes text,
as protobuf writes such numbers, and a goal that has one is rejected.
"""

from __future__ import annotations

from typing import Any

from a2a.types import Part
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.struct_pb2 import Struct, Value

from fibaction.schema.payload import JsonCodec, PayloadError, to_json
from fibaction.words.plain_data import is_list, is_map
from fibaction_transports.a2a.documents import LARGEST

LONGEST_TEXT = 10_000
"""Characters of a result that is told as text, too."""


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


def shown_text(codec: JsonCodec, payload: bytes) -> str:
    """Return a payload as text for models: text as it is, the rest as JSON; empty if it is long."""
    data = codec.decode(payload)
    text = data if isinstance(data, str) else to_json(data)
    return text if len(text) <= LONGEST_TEXT else ""


def struct_of(data: dict[str, Any]) -> Struct:
    """Return metadata as a message."""
    struct = Struct()
    struct.update(_exact(data))
    return struct


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
