"""`RosbridgeConnection`: the actions of a rosbridge server, for clients."""

from __future__ import annotations

from typing import Any

from fibaction.abc import Connection, Endpoint
from fibaction.action import Action, ActionInfo
from fibaction_transports.web.rosbridge._client_endpoint import RosbridgeEndpoint
from fibaction_transports.web.rosbridge._link_keeper import LinkKeeper


class RosbridgeConnection(Connection):
    """The actions of one rosbridge server."""

    def __init__(self, keeper: LinkKeeper) -> None:
        self._keeper = keeper

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        """See `Connection.endpoint`.

        Raises:
            TransportError: The schemas of the action cannot be used.
        """
        return RosbridgeEndpoint(
            self._keeper, action.info if isinstance(action, Action) else action
        )

    async def actions(self) -> list[ActionInfo]:
        """See `Connection.actions`. rosapi tells names and types; the schemas are empty."""
        return [
            ActionInfo(name.removeprefix("/"), await self._keeper.type_of(name))
            for name in await self._keeper.action_names()
        ]
