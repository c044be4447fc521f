"""`a2a+http://host:port` and `a2a+https://host:port`: the Agent2Agent protocol over HTTP."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import ClassVar

from a2a.server.request_handlers.request_handler import RequestHandler
from a2a.server.routes import create_agent_card_routes, create_jsonrpc_routes
from a2a.types import AgentCard
from a2a.utils.constants import AGENT_CARD_WELL_KNOWN_PATH
from starlette.applications import Starlette

from fibaction.border.gateway import Gateway, ServerGroup
from fibaction.border.peer_text import clean_logger
from fibaction.wire.auth import Peer
from fibaction_transports._agents.agent_goals import AgentGoals
from fibaction_transports._agents.agent_http_transport import (
    AgentGateway,
    AgentHttpTransport,
    DocumentApp,
)
from fibaction_transports._http.exchange import App, Receive, Scope, Send
from fibaction_transports.a2a.agent_card import CardMaker, Skill, Skills
from fibaction_transports.a2a.documents import ASKED, AskedRequest, asked_request, take_documents
from fibaction_transports.a2a.goal_requests import GoalRequests

PATH = "/"
CARD_PATH = AGENT_CARD_WELL_KNOWN_PATH
_LOGGERS = (
    "a2a.server.routes.jsonrpc_dispatcher",
    "a2a.compat.v0_3.jsonrpc_adapter",
)
"""The loggers of the SDK for what clients send."""


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
        ASKED.set(AskedRequest(url, name, scope["state"].get("documents") or ()))
        await self._app(scope, receive, send)

    async def _card(self, _: AgentCard) -> AgentCard:
        asked = asked_request()
        return self._cards.card(asked.url, is_known=asked.is_known)


class A2aHttpTransport(AgentHttpTransport):
    """The Agent2Agent protocol (A2A 1.0), for any number of agents. It runs on asyncio only.

    An action is a skill, a goal is a task, and feedback is an update of its status. Each agent
    needs a token, so that no other user of the machine can move a robot.

    For example:

        async with serve(ActionServer(LOOK, look), A2aHttpTransport(token=TOKEN)) as (url,):
            print(f"the agent card is at {url}.well-known/agent-card.json")
    """

    schemes: ClassVar[tuple[str, str]] = ("a2a+http", "a2a+https")
    tls_schemes: ClassVar[tuple[str, ...]] = ("a2a+https",)
    default_port: ClassVar[int] = 8091
    clients: ClassVar[str] = "agents"

    @asynccontextmanager
    async def serve_group(self, group: ServerGroup) -> AsyncGenerator[Gateway, None]:
        """See `GatewayTransport.serve_group`. The names are the IDs of the skills."""
        skills = Skills(group, self.policy, Skill)
        cards = CardMaker(skills, self.policy)
        goals = AgentGoals(skills)
        requests = GoalRequests(skills, goals, cards, self.policy)
        app = DocumentApp(A2aApp(requests, cards), take_documents, error_status=200)
        async with goals.followed(), self.serve_app(app, PATH, CARD_PATH) as url:
            yield AgentGateway(url, lambda: sorted(skills.by_label))
