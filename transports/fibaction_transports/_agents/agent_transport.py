"""`AgentTransport` and `AgentGateway`: what all transports for agents have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NoReturn

from fibaction.border.gateway import Gateway, GatewayTransport
from fibaction.border.settings import TransportSettings
from fibaction.wire.transport import ConfiguredTransport
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_policy import AgentPolicy


class AgentTransport(GatewayTransport, ConfiguredTransport):
    """Actions for agents. It only serves."""

    settings_type: ClassVar[type[TransportSettings]] = AgentPolicy
    clients: ClassVar[str]
    """The clients, in the plural, for people."""

    def __init__(self, policy: AgentPolicy) -> None:
        self.policy = policy
        """The rules for what an agent may do."""

    def connect(self) -> NoReturn:
        """Raise an error: the clients are agents.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"the clients of {self.url} are {self.clients}: connect to the servers of its actions"
        )


class AgentGateway(Gateway):
    """The serving end for agents: its URL, and the names that they have for the actions."""

    def __init__(self, url: str, names: Callable[[], list[str]]) -> None:
        self._url = url
        self._names = names

    @property
    def url(self) -> str:
        return self._url

    @property
    def names(self) -> list[str]:
        return self._names()
