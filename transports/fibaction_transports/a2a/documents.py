"""The data in messages of A2A: documents, which do not go through protobuf, and values that do.

Numbers of A2A are 64-bit floats, so a whole number beyond 2**53 cannot be carried exactly. One that
is sent to an agent becomes text, as protobuf writes such numbers, and a goal that has one is
rejected.
"""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any, NamedTuple

from a2a.types import Part
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.struct_pb2 import Struct, Value

from fibaction.schema.payload import JsonCodec, PayloadError, to_json
from fibaction.words.plain_data import is_list, is_map

MOST_PARTS = 100
"""Parts of a message; those after them are left out, since a goal is one part."""
LARGEST = 2**53
"""The largest whole number up to which floats have all of them."""
LONGEST_TEXT = 10_000
"""Characters of a result that is told as text, too."""


class Document(NamedTuple):
    """The content of one part of a message."""

    kind: str
    """`data` or `text`; anything else is empty."""
    value: Any = None


class AskedRequest(NamedTuple):
    """The request that is being answered."""

    url: str
    """The URL of this server, as its client calls it."""
    client: str | None
    """The name that belongs to the client's token; None without a token."""
    documents: tuple[Document, ...]
    """The documents of its message, one for each part."""

    @property
    def is_known(self) -> bool:
        """True if the client has a token."""
        return self.client is not None


ASKED: ContextVar[AskedRequest] = ContextVar("ASKED")


def asked_request() -> AskedRequest:
    """Return the request that the calling task answers."""
    return ASKED.get()


def take_documents(request: dict[str, Any]) -> tuple[Document, ...]:
    """Take the data and the texts out of the parts of a message."""
    params = request.get("params")
    message = params.get("message") if is_map(params) else None
    parts = message.get("parts") if is_map(message) else None
    if not (is_map(message) and is_list(parts)):
        return ()
    message["parts"] = [*parts][:MOST_PARTS]
    return tuple(map(_document, message["parts"]))


def _document(part: Any) -> Document:
    """Return the content of a part, and leave an empty one in its place."""
    if is_map(part):
        if "data" in part:
            data, part["data"] = part["data"], {}
            return Document("data", _with_integers(data))
        if isinstance(text := part.get("text"), str):
            part["text"] = ""
            return Document("text", text)
    return Document("")


def _with_integers(data: Any) -> Any:
    """Return data whose whole numbers are integers: a client of protobuf writes 3 as 3.0."""
    if is_map(data):
        return {name: _with_integers(one) for name, one in data.items()}
    if is_list(data):
        return [_with_integers(one) for one in data]
    if isinstance(data, float) and data.is_integer() and abs(data) <= LARGEST:
        return int(data)
    return data


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
