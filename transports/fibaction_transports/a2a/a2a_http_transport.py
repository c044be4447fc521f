"""`a2a+http://host:port` and `a2a+https://host:port`: the Agent2Agent protocol over HTTP."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import ClassVar

from fibaction.border.gateway import Gateway, ServerGroup
from fibaction_transports._agents.agent_goals import AgentGoals
from fibaction_transports._agents.agent_http_transport import AgentGateway, AgentHttpTransport
from fibaction_transports._agents.document_app import DocumentApp
from fibaction_transports.a2a.a2a_app import CARD_PATH, PATH, A2aApp
from fibaction_transports.a2a.agent_card import CardMaker, Skill, Skills
from fibaction_transports.a2a.documents import take_documents
from fibaction_transports.a2a.goal_requests import GoalRequests


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
