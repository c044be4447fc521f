"""`RobotActions`: the actions of some servers, as tools.

A tool keeps its name for as long as its action is there. What cannot be used here, for example
because its ROS type is not installed, is left out, and the log says so once.
"""

from __future__ import annotations

from collections.abc import Mapping

from fibaction.border.abc import Connection, Notifier
from fibaction.border.gateway import SeenServer, ServerGroup
from fibaction.border.peer_text import clean_logger, excerpt
from fibaction.client.client import ActionClient
from fibaction.schema.payload import JsonCodec, PayloadError
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import TransportError
from fibaction.words.statuses import GoalStatus
from fibaction_transports.mcp.agent_policy import AgentPolicy
from fibaction_transports.mcp.tools.tool_names import CANCEL, SEND, STATUS, tool_name
from fibaction_transports.mcp.tools.tool_schema import tool_input, tool_output

MOST_ACTIONS = 200
"""Actions of one server that become tools; far fewer are too many for most models."""

logger = clean_logger("fibaction.mcp")


class RobotAction:
    """One action that is served now, and its tool."""

    def __init__(self, server: str, info: ActionInfo, connection: Connection, tool: str):
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
        self.output = tool_output(info.result, (status.name for status in GoalStatus))
        self.client = ActionClient(connection.endpoint(info), Action.untyped(info))

    @property
    def title(self) -> str:
        """The action for people: its name, with that of its server if there are several."""
        name = excerpt(self.info.name.lstrip("/"))
        return f"{name} of {self.server}" if self.server else name


class RobotActions:
    """The actions of a group of servers, as far as a model may know them."""

    def __init__(self, group: ServerGroup, policy: AgentPolicy) -> None:
        self.news = Notifier()
        """Notified when the list of tools has changed."""
        self._group = group
        self._policy = policy
        self._taken: dict[str, SeenServer] = {}
        self._known: dict[str, dict[str, RobotAction]] = {}
        self._left_out: set[tuple[str, str]] = set()

    @property
    def problems(self) -> dict[str, str]:
        """For each server, the reason why it cannot be reached now; empty if it can."""
        return self._group.problems

    @property
    def are_all_reached(self) -> bool:
        """True if all servers have told their actions, and can be asked now."""
        self.refresh()
        problems = self._group.problems
        return all(server in self._taken and not text for server, text in problems.items())

    @property
    def tools(self) -> dict[str, RobotAction]:
        """The actions by the names of their tools."""
        self.refresh()
        # In the order of the servers, whichever of them has answered first.
        known = [self._known.get(server, {}) for server in self._group.problems]
        return {one.tool: one for actions in known for one in actions.values()}

    def refresh(self) -> None:
        """Make tools of the actions that the servers have now."""
        for server, seen in self._group.servers.items():
            if seen is not self._taken.get(server):
                self._taken[server] = seen
                self._take(server, seen)

    async def follow(self) -> None:
        """Refresh the tools whenever an action comes or goes, until canceled."""
        while True:
            self.refresh()
            await self._group.news.wait()

    def _take(self, server: str, seen: SeenServer) -> None:
        """Make tools of the actions of a server, and of no others of it."""
        before, now = self._known.get(server, {}), dict[str, RobotAction]()
        for info in seen.actions:
            if not self._policy.allows(server, info.name):
                continue
            if len(now) == MOST_ACTIONS:
                self._leave_out(server, info, f"only {MOST_ACTIONS} actions can be tools")
                continue
            known = before.get(info.name)
            if known is None or known.info != info or known.connection is not seen.connection:
                tool = known.tool if known else self._new_name(server, info.name, now)
                try:
                    known = RobotAction(server, info, seen.connection, tool)
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
        parts = (*self._known.values(), now)
        taken = {SEND, STATUS, CANCEL, *(one.tool for part in parts for one in part.values())}
        return tool_name(server, action, taken)

    def _leave_out(self, server: str, info: ActionInfo, reason: str) -> None:
        if (server, info.name) not in self._left_out and len(self._left_out) < MOST_ACTIONS:
            self._left_out.add((server, info.name))
            logger.warning("action %s is left out: %s", info.name, reason)
