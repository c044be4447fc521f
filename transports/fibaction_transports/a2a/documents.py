"""The documents of messages: goals and answers, which are taken out of a request before the SDK
reads it.

The SDK makes protobuf messages of a request, and checks each of them: 100 kB of `{"data": [1, 1]}`
would keep the event loop for more than a second. So the data and the texts of the parts are read
here, in a thread if the request is large, and what is left for the SDK has a small bound.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from fibaction.schema.turns import read_json
from fibaction.words.plain_data import is_list, is_map

LARGEST_REST = 2**14
"""Bytes of a request without its documents."""
MOST_PARTS = 100
"""Parts of a message; those after them are left out, since a goal is one part."""

PARSE_ERROR, INVALID_REQUEST = -32700, -32600


class Document(NamedTuple):
    """The content of one part of a message."""

    kind: str
    """`data` or `text`; anything else is empty."""
    value: Any = None


class RequestError(Exception):
    """An error for a request that the SDK does not get."""

    def __init__(self, code: int, text: str, request_id: object = None) -> None:
        super().__init__(text)
        self.code = code
        self.request_id = request_id if isinstance(request_id, str | int) else None


class Request(NamedTuple):
    """A request, and the documents that were taken out of it."""

    rest: bytes
    documents: tuple[Document, ...] = ()


def read_request(body: bytes) -> Request:
    """Take the documents out of a request.

    Raises:
        RequestError: It is not JSON, or has much more than its documents.
    """
    try:
        return _read(body)
    except ValueError as exc:
        raise RequestError(PARSE_ERROR, f"the request is not JSON: {exc}") from exc
    except RecursionError as exc:
        raise RequestError(PARSE_ERROR, "the request nests too deep") from exc


def _read(body: bytes) -> Request:
    request = read_json(body)
    params = request.get("params") if is_map(request) else None
    message = params.get("message") if is_map(params) else None
    parts = message.get("parts") if is_map(message) else None
    documents: tuple[Document, ...] = ()
    if is_map(message) and is_list(parts):
        message["parts"] = [*parts][:MOST_PARTS]
        documents = tuple(map(_document, message["parts"]))
    rest = msgspec.json.encode(request)
    if len(rest) > LARGEST_REST:
        request_id = request.get("id") if is_map(request) else None
        text = f"the request has {len(rest)} bytes beside its parts; {LARGEST_REST} are the limit"
        raise RequestError(INVALID_REQUEST, text, request_id)
    return Request(rest, documents)


def _document(part: Any) -> Document:
    """Return what a part holds, and leave an empty one in its place."""
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


LARGEST = 2**53
"""The largest whole number up to which floats have all of them."""
