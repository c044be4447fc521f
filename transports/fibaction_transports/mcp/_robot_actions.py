"""`RobotActions`: the actions of some servers, as they come and go.

Theory of operation
-------------------

A task for each server connects, and looks for actions again and again. While the server does not
answer, its actions stay as they were known: a list of tools that flickers helps nobody, and a goal
that is sent meanwhile gets the reason as its answer. When a connection is over, the task opens
another one, and each action gets a client over that.

A tool keeps its name for as long as its action is there. What cannot be used here, for example
because its ROS type is not installed, is left out, and the log says so once.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, Iterable, Mapping
from contextlib import asynccontextmanager

import anyio

from fibaction._api import ClientConnection, connect
from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.tasks import Background
from fibaction._runtime.text import excerpt
from fibaction.border.abc import Transport
from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    ProtocolError,
    ServerNotFound,
    TransportError,
)
from fibaction_transports.mcp._tool_names import CANCEL, SEND, STATUS, tool_name
from fibaction_transports.mcp._tool_schema import tool_input
from fibaction_transports.mcp.agent_policy import AgentPolicy

PERIOD = 1.0
"""Seconds between two looks for actions."""
LOOK_TIMEOUT = 5.0
"""Seconds that a server has to answer a look."""
NEXT_CONNECTION = 2.0
"""Seconds between two attempts to connect."""
FIRST_LOOK = 3.0
"""Seconds that the start waits for the actions of all servers."""
MOST_ACTIONS = 200
"""Actions of one server that become tools; far fewer are too many for most models."""

_OVER = (AuthenticationFailed, ConnectionLost, InvalidURL, ProtocolError, ServerNotFound)
"""Errors after which a connection, and all that was open over it, is of no more use."""

logger = clean_logger("fibaction.mcp")


class RobotAction:
    """One action that is served now, and its tool."""

    def __init__(self, server: str, info: ActionInfo, connection: ClientConnection, tool: str):
        """Describe an action.

        Raises:
            PayloadError: The schema of its goals cannot be used.
            TransportError: It cannot be used from here.
        """
        self.server = server
        """The name of its server; empty if there is only one."""
        self.info = info
        self.connection = connection
        self.tool = tool
        """The name of its tool."""
        self.goals = JsonCodec(info.goal)
        self.input = tool_input(info.goal)
        self.client = connection.client(Action.untyped(info))

    @property
    def title(self) -> str:
        """The action for people: its name, with that of its server if there are several."""
        name = excerpt(self.info.name.lstrip("/"))
        return f"{name} of {self.server}" if self.server else name


class RobotActions:
    """The actions of some servers, as far as a model may know them."""

    def __init__(self, servers: Mapping[str, str | Transport], policy: AgentPolicy) -> None:
        """Map the names of the servers to their addresses."""
        self.news = Notifier()
        """Told when the list of tools has changed."""
        self.problems: dict[str, str] = dict.fromkeys(servers, "it has not answered yet")
        """For each server, the reason why it cannot be reached now; empty if it can."""
        self._servers = servers
        self._policy = policy
        self._known: dict[str, dict[str, RobotAction]] = {name: {} for name in servers}
        self._left_out: set[tuple[str, str]] = set()
        self._looked = {name: anyio.Event() for name in servers}

    @property
    def tools(self) -> dict[str, RobotAction]:
        """The actions by the names of their tools."""
        return {one.tool: one for known in self._known.values() for one in known.values()}

    @asynccontextmanager
    async def followed(self) -> AsyncGenerator[None, None]:
        """Follow the servers during the block, which begins when all have answered, or soon."""
        async with Background() as tasks:
            for server, where in self._servers.items():
                tasks.start_soon(self._follow, server, where)
            with anyio.move_on_after(FIRST_LOOK):
                for looked in self._looked.values():
                    await looked.wait()
            yield

    async def _follow(self, server: str, where: str | Transport) -> None:
        while True:
            try:
                async with connect(where) as connection:
                    await self._look(server, connection)
            except ActionError as exc:
                self._note(server, str(exc))
            await anyio.sleep(NEXT_CONNECTION)

    async def _look(self, server: str, connection: ClientConnection) -> None:
        """Look for actions that have come or gone, until the connection is over.

        Raises:
            ActionError: It is.
        """
        while True:
            problem = "it does not answer"
            with anyio.move_on_after(LOOK_TIMEOUT):
                try:
                    self._take(server, connection, await connection.actions())
                    problem = ""
                except _OVER:
                    raise
                except ActionError as exc:
                    problem = str(exc)
            self._note(server, problem)
            await anyio.sleep(PERIOD)

    def _note(self, server: str, problem: str) -> None:
        if problem != self.problems[server] and (problem or self._looked[server].is_set()):
            name = f"server {server}" if server else "the server"
            logger.warning("%s: %s", name, problem or "it answers again")
        self.problems[server] = problem
        self._looked[server].set()

    def _take(self, server: str, connection: ClientConnection, infos: Iterable[ActionInfo]) -> None:
        """Make tools of these actions, and of no others of the server."""
        before, now = self._known[server], dict[str, RobotAction]()
        for info in infos:
            if not self._policy.allows(server, info.name):
                continue
            if len(now) == MOST_ACTIONS:
                self._leave_out(server, info, f"only {MOST_ACTIONS} actions can be tools")
                continue
            known = before.get(info.name)
            if known is None or known.info != info or known.connection is not connection:
                tool = known.tool if known else self._new_name(server, info.name, now)
                try:
                    known = RobotAction(server, info, connection, tool)
                except (TransportError, PayloadError) as exc:
                    self._leave_out(server, info, str(exc))
                    continue
            now[info.name] = known
        self._known[server] = now
        if {name: one.info for name, one in before.items()} != {
            name: one.info for name, one in now.items()
        }:
            self.news.notify()

    def _new_name(self, server: str, action: str, now: Mapping[str, RobotAction]) -> str:
        taken = {SEND, STATUS, CANCEL, *self.tools, *(one.tool for one in now.values())}
        return tool_name(server, action, taken)

    def _leave_out(self, server: str, info: ActionInfo, reason: str) -> None:
        if (server, info.name) not in self._left_out and len(self._left_out) < MOST_ACTIONS:
            self._left_out.add((server, info.name))
            logger.warning("action %s is left out: %s", info.name, reason)
