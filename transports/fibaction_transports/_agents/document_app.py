"""`DocumentApp`: takes the documents out of the requests of agents, before an SDK reads them.

The SDKs make models of all that a request has, and check each of them on the event loop, which
takes seconds for a large goal. So the goals are taken out of the JSON here, in a thread if the
request is large, and what is left has a small bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import msgspec
from starlette.responses import JSONResponse

from fibaction.border.peer_text import excerpt
from fibaction.schema.turns import in_turn, read_json
from fibaction.words.plain_data import is_map
from fibaction_transports._http.exchange import App, Message, Receive, Scope, Send

LARGEST_REST = 2**14
"""Bytes of a request without its documents."""
PARSE_ERROR, INVALID_REQUEST = -32700, -32600
"""Codes of errors of JSON-RPC."""

LENGTH = b"content-length"

Take: TypeAlias = Callable[[dict[str, Any]], Any]
"""Takes the documents out of a request, and leaves small values in their places."""


class RequestError(Exception):
    """An error for a request that the SDK does not get."""

    def __init__(self, code: int, text: str, request_id: object = None) -> None:
        super().__init__(text)
        self.code = code
        self.request_id = request_id if isinstance(request_id, str | int) else None


class DocumentApp:
    """An application of an SDK, in whose scope `state["documents"]` is what `take` returns."""

    def __init__(self, app: App, take: Take, error_status: int) -> None:
        self._app = app
        self._take = take
        self._error_status = error_status

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["method"] == "POST":
            body: bytes = (await receive())["body"]
            try:
                rest, documents = await in_turn(len(body), lambda _: split(body, self._take))
            except RequestError as exc:
                error = {"code": exc.code, "message": excerpt(str(exc))}
                answer = {"jsonrpc": "2.0", "id": exc.request_id, "error": error}
                await JSONResponse(answer, self._error_status)(scope, receive, send)
                return
            scope["state"]["documents"] = documents
            others = [one for one in scope["headers"] if one[0].lower() != LENGTH]
            scope["headers"] = [*others, (LENGTH, str(len(rest)).encode())]
            receive = _after(rest, receive)
        await self._app(scope, receive, send)


def split(body: bytes, take: Take) -> tuple[bytes, Any]:
    """Return what is left of a request, and its documents; None if it is not an object.

    Raises:
        RequestError: It is not JSON, or has much more than its documents.
    """
    try:
        return _split(read_json(body), take)
    except ValueError as exc:
        raise RequestError(PARSE_ERROR, f"the request is not JSON: {exc}") from exc
    except RecursionError as exc:
        raise RequestError(PARSE_ERROR, "the request nests too deep") from exc


def _split(request: Any, take: Take) -> tuple[bytes, Any]:
    documents = take(request) if is_map(request) else None
    rest = msgspec.json.encode(request)
    if len(rest) > LARGEST_REST:
        request_id = request.get("id") if is_map(request) else None
        text = f"the request has {len(rest)} bytes beside its goal; {LARGEST_REST} are the limit"
        raise RequestError(INVALID_REQUEST, text, request_id)
    return rest, documents


def _after(body: bytes, receive: Receive) -> Receive:
    """Return a function that receives a body, and then what `receive` does."""
    pieces = [{"type": "http.request", "body": body}]

    async def received() -> Message:
        return pieces.pop() if pieces else await receive()

    return received
