"""`AgentTransport`: the part that all transports for agents have in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NoReturn, Unpack

from fibaction.border.gateway import GatewayTransport
from fibaction.wire.settings import WireKeywords
from fibaction.wire.transport import ConfiguredTransport, boolean
from fibaction.words.errors import TransportError
from fibaction_transports._agents.agent_policy import AgentPolicy


def items(text: str) -> tuple[str, ...]:
    """Return the items of a setting in a URL, which has commas between them."""
    return tuple(text.split(","))


class AgentTransport(GatewayTransport, ConfiguredTransport):
    """Actions for agents. It only serves."""

    wire_settings: ClassVar[tuple[str, ...]] = ()
    own_settings: ClassVar[tuple[str, ...]] = ("allow", "unasked", "read_only", "patience")
    own_url_settings: ClassVar = {
        "allow": items,
        "unasked": items,
        "read_only": boolean,
        "patience": float,
    }
    clients: ClassVar[str]
    """The clients, in the plural, for people."""

    def __init__(
        self,
        *,
        allow: Iterable[str] = ("*",),
        unasked: Iterable[str] = (),
        read_only: bool = False,
        patience: float = 50.0,
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take the rules for what an agent may do: see `AgentPolicy`.

        Raises:
            TypeError: There is no such setting.
            ValueError: The patience is not a number of seconds, a pattern is empty, or a token is
                not valid text.
        """
        super().__init__(**settings)
        self.policy = AgentPolicy(tuple(allow), tuple(unasked), read_only, patience)
        """The rules for what an agent may do."""

    def connect(self) -> NoReturn:
        """Raise an error: the clients are agents.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"the clients of {self.url} are {self.clients}: connect to the servers of its actions"
        )
