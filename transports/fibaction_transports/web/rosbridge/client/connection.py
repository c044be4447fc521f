"""`RosbridgeConnection`: the actions of a rosbridge server, for clients."""

from __future__ import annotations

from typing import Any

from fibaction.border.abc import Connection, Endpoint
from fibaction.types.action import Action, ActionInfo
from fibaction.words.goals import ActionPeers
from fibaction_transports.web.rosbridge.client.endpoint import RosbridgeEndpoint
from fibaction_transports.web.rosbridge.client.link_opener import LinkKeeper


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
        """See `Connection.actions`. The schemas are those that rosapi tells, or empty."""
        return [await self._described(name) for name in await self._keeper.action_names()]

    async def peers(self, action: str) -> ActionPeers:
        """See `Connection.peers`. It is the rosbridge server; rosapi tells no clients."""
        names = [name.removeprefix("/") for name in await self._keeper.action_names()]
        return ActionPeers((self._keeper.url,) if action in names else ())

    async def _described(self, name: str) -> ActionInfo:
        type_name = await self._keeper.type_of(name)
        schemas = await self._keeper.schemas_of(type_name)
        return ActionInfo(name.removeprefix("/"), type_name, *schemas)
