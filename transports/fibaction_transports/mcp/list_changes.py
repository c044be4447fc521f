"""`ListChanges`: tells the clients that the list of tools has changed.

A client with a handshake (MCP up to 2025-11-25) gets a notification on its connection. A client
without one (from 2026-07-28 on) asks for a stream of changes by `subscriptions/listen`.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from mcp.server.context import ServerRequestContext
from mcp.server.session import ServerSession
from mcp.server.subscriptions import (
    InMemorySubscriptionBus,
    ListenHandler,
    ServerEvent,
    ToolsListChanged,
)
from mcp_types.version import MODERN_PROTOCOL_VERSIONS

MOST_SESSIONS = 1000
"""Sessions that are told; the oldest of more are forgotten. Over HTTP a client may just vanish."""
TELL_TIMEOUT = 5.0
"""Seconds that a client has to take the notification."""
SESSION_HEADER = "mcp-session-id"


class ListChanges:
    """The clients that know the list of tools."""

    def __init__(
        self, *, most_sessions: int = MOST_SESSIONS, tell_timeout: float = TELL_TIMEOUT
    ) -> None:
        self._most_sessions = most_sessions
        self._tell_timeout = tell_timeout
        self._bus = InMemorySubscriptionBus()
        self.listen = ListenHandler(self._bus)
        """The handler of `subscriptions/listen`."""
        self._sessions: dict[Any, ServerSession] = {}

    @asynccontextmanager
    async def connection(self) -> AsyncGenerator[object, None]:
        """Give a connection its identity, while it lasts."""
        identity = object()
        try:
            yield identity
        finally:
            self._sessions.pop(identity, None)

    def note(self, context: ServerRequestContext[Any, Any]) -> None:
        """Note that a client has read the list."""
        if context.protocol_version in MODERN_PROTOCOL_VERSIONS:
            return
        headers = getattr(context.request, "headers", {})
        key = headers.get(SESSION_HEADER, context.lifespan_context)
        self._sessions.pop(key, None)
        self._sessions[key] = context.session
        if len(self._sessions) > self._most_sessions:
            del self._sessions[next(iter(self._sessions))]

    async def publish(self, event: ServerEvent) -> None:
        """Tell the clients that have asked for a stream of such changes."""
        await self._bus.publish(event)

    async def tell(self) -> None:
        """Tell all clients that the list has changed."""
        await self.publish(ToolsListChanged())
        with anyio.move_on_after(self._tell_timeout):
            async with anyio.create_task_group() as tasks:
                for session in self._sessions.values():
                    tasks.start_soon(session.send_tool_list_changed)
