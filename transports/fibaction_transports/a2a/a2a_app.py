"""The application of A2A: the routes of the SDK, and the request that a card is for."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from typing import NamedTuple

from a2a.server.request_handlers.request_handler import RequestHandler
from a2a.server.routes import create_agent_card_routes, create_jsonrpc_routes
from a2a.types import AgentCard
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from starlette.applications import Starlette

from fibaction.border.peer_text import clean_logger
from fibaction.wire.auth import Peer
from fibaction_transports._http.exchange import App, Receive, Scope, Send
from fibaction_transports.a2a.agent_card import CardMaker
from fibaction_transports.a2a.documents import Document

PATH = "/"
CARD_PATH = AGENT_CARD_WELL_KNOWN_PATH
_LOGGERS = (
    "a2a.server.routes.jsonrpc_dispatcher",
    "a2a.compat.v0_3.jsonrpc_adapter",
)
"""The loggers of the SDK for what clients send."""


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


_ASKED: ContextVar[AskedRequest] = ContextVar("_ASKED")


def asked_request() -> AskedRequest:
    """Return the request that the calling task answers."""
    return _ASKED.get()


def _is_not_of_garbage(record: logging.LogRecord) -> bool:
    """Return whether to log a record of the SDK: not the traceback for what a client has sent,
    before the line about the answer.
    """
    return not (record.exc_info and record.getMessage().startswith("Failed to "))


class A2aApp:
    """The routes of one server, for clients that were let in."""

    def __init__(self, requests: RequestHandler, cards: CardMaker) -> None:
        self._cards = cards
        made_for_each_request = cards.card(f"http://localhost{PATH}", is_known=False)
        routes = [
            *create_agent_card_routes(made_for_each_request, self._card),
            *create_jsonrpc_routes(requests, PATH, enable_v0_3_compat=True),
        ]
        for name in _LOGGERS:
            clean_logger(name).addFilter(_is_not_of_garbage)
        self._app: App = Starlette(routes=routes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        host = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
        url = f"{scope['scheme']}://{host}{PATH}"
        client: Peer | None = scope["state"]["client"]
        name = None if client is None else client.name
        _ASKED.set(AskedRequest(url, name, scope["state"].get("documents") or ()))
        await self._app(scope, receive, send)

    async def _card(self, _: AgentCard) -> AgentCard:
        asked = asked_request()
        return self._cards.card(asked.url, is_known=asked.is_known)
