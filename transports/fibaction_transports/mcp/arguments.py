"""The arguments of tools, which come beside the request of the SDK if they came by HTTP."""

from __future__ import annotations

from typing import Any

from mcp.server.context import ServerRequestContext
from mcp_types import CallToolRequestParams

from fibaction.wire.auth import Peer
from fibaction.words.plain_data import is_map

CALL = "tools/call"


def take_arguments(request: dict[str, Any]) -> dict[str, Any] | None:
    """Take the arguments out of the call of a tool; return None if it is not one."""
    params = request.get("params")
    if request.get("method") != CALL or not is_map(params):
        return None
    arguments = params.get("arguments")
    if not is_map(arguments):
        return None
    params["arguments"] = {}
    return dict(arguments)


def state_of(context: ServerRequestContext[Any, Any]) -> dict[str, Any]:
    """Return what the HTTP server knows about a request; nothing if it came otherwise."""
    scope: dict[str, Any] = getattr(context.request, "scope", {})
    state: dict[str, Any] = scope.get("state", {})
    return state


def with_arguments(
    context: ServerRequestContext[Any, Any], params: CallToolRequestParams
) -> CallToolRequestParams:
    """Return the parameters of a call with the arguments that were taken out of its request."""
    arguments = state_of(context).get("documents")
    return params if arguments is None else params.model_copy(update={"arguments": arguments})


def client_of(context: ServerRequestContext[Any, Any]) -> str:
    """Return the name that belongs to the client's token; empty if the transport has no tokens."""
    client: Peer | None = state_of(context).get("client")
    return "" if client is None else client.name
