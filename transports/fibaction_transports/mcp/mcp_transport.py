"""`McpTransport`: the part that MCP over stdio and over HTTP have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncGenerator, Iterable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, ClassVar, NoReturn, Unpack

from mcp.server import Server

from fibaction.border.gateway import Gateway, GatewayTransport, ServerGroup
from fibaction.wire.settings import WireKeywords
from fibaction.wire.transport import ConfiguredTransport, boolean
from fibaction.words.errors import TransportError
from fibaction_transports.mcp.agent_policy import AgentPolicy
from fibaction_transports.mcp.tool_server import ToolServer


def items(text: str) -> tuple[str, ...]:
    """Return the items of a setting in a URL, which has commas between them."""
    return tuple(text.split(","))


class McpTransport(GatewayTransport, ConfiguredTransport):
    """Actions as tools of language models, by the Model Context Protocol. It only serves."""

    wire_settings: ClassVar[tuple[str, ...]] = ()
    own_settings: ClassVar[tuple[str, ...]] = ("allow", "unasked", "read_only", "patience")
    own_url_settings: ClassVar = {
        "allow": items,
        "unasked": items,
        "read_only": boolean,
        "patience": float,
    }

    def __init__(
        self,
        *,
        allow: Iterable[str] = ("*",),
        unasked: Iterable[str] = (),
        read_only: bool = False,
        patience: float = 50.0,
        **settings: Unpack[WireKeywords],
    ) -> None:
        """Take the rules for what a model may do: see `AgentPolicy`.

        Raises:
            TypeError: There is no such setting.
            ValueError: The patience is not a number of seconds, a pattern is empty, or a token is
                not valid text.
        """
        super().__init__(**settings)
        self.policy = AgentPolicy(tuple(allow), tuple(unasked), read_only, patience)
        """The rules for what a model may do."""

    @abstractmethod
    def offer(self, server: Server[Any]) -> AbstractAsyncContextManager[str]:
        """Let clients reach a server of the SDK for as long as the block lasts, which gets the URL.

        Raises:
            TransportError: The address cannot be used.
        """

    @asynccontextmanager
    async def serve_group(self, group: ServerGroup) -> AsyncGenerator[Gateway, None]:
        """See `GatewayTransport.serve_group`. The names are those of the tools."""
        async with ToolServer(group, self.policy) as tools, self.offer(tools.server) as url:
            yield _McpGateway(url, tools)

    def connect(self) -> NoReturn:
        """Raise an error: the clients are language models.

        Raises:
            TransportError: Always.
        """
        raise TransportError(
            f"the clients of {self.url} are language models: connect to the servers of its actions"
        )


class _McpGateway(Gateway):
    """The tools of a gateway, and the URL where they are."""

    def __init__(self, url: str, tools: ToolServer) -> None:
        self._url = url
        self._tools = tools

    @property
    def url(self) -> str:
        return self._url

    @property
    def names(self) -> list[str]:
        return self._tools.names
