"""The application of A2A: the routes of the SDK, and the request that a card is for."""

from __future__ import annotations

from contextvars import ContextVar
from typing import NamedTuple

from a2a.server.request_handlers.request_handler import RequestHandler
from a2a.server.routes import create_agent_card_routes, create_jsonrpc_routes
from a2a.types import AgentCard
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from starlette.applications import Starlette

from fibaction.wire.auth import Peer
from fibaction_transports._http.exchange import App, Receive, Scope, Send
from fibaction_transports.a2a.agent_card import CardMaker

PATH = "/"
CARD_PATH = AGENT_CARD_WELL_KNOWN_PATH


class AskedRequest(NamedTuple):
    """The request that is being answered."""

    url: str
    """The URL of this server, as its client calls it."""
    client: str | None
    """The name that belongs to the client's token; None without a token."""

    @property
    def is_known(self) -> bool:
        """True if the client has a token."""
        return self.client is not None


_ASKED: ContextVar[AskedRequest] = ContextVar("_ASKED")


def asked_request() -> AskedRequest:
    """Return the request that the calling task answers."""
    return _ASKED.get()


def note_request(url: str, client: str | None) -> None:
    """Note the request that the calling task answers from now on."""
    _ASKED.set(AskedRequest(url, client))


class A2aApp:
    """The routes of one server, for clients that were let in."""

    def __init__(self, requests: RequestHandler, cards: CardMaker) -> None:
        self._cards = cards
        made_for_each_request = cards.card(f"http://localhost{PATH}", is_known=False)
        routes = [
            *create_agent_card_routes(made_for_each_request, self._card),
            *create_jsonrpc_routes(requests, PATH),
        ]
        self._app: App = Starlette(routes=routes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        host = dict(scope["headers"]).get(b"host", b"").decode("latin-1")
        url = f"{scope['scheme']}://{host}{PATH}"
        client: Peer | None = scope["state"]["client"]
        note_request(url, None if client is None else client.name)
        await self._app(scope, receive, send)

    async def _card(self, _: AgentCard) -> AgentCard:
        asked = asked_request()
        return self._cards.card(asked.url, is_known=asked.is_known)
