"""The documents of messages of A2A, goals and answers, which do not go through protobuf."""

from __future__ import annotations

from typing import Any, NamedTuple

from fibaction.words.plain_data import is_list, is_map

MOST_PARTS = 100
"""Parts of a message; those after them are left out, since a goal is one part."""
LARGEST = 2**53
"""The largest whole number up to which floats have all of them."""


class Document(NamedTuple):
    """The content of one part of a message."""

    kind: str
    """`data` or `text`; anything else is empty."""
    value: Any = None


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
