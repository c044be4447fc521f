"""The actions of one side of a bridge, as they come and go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import anyio

from fibaction._action_listener import PERIOD
from fibaction.abc import Connection, Endpoint
from fibaction.action import ActionInfo
from fibaction.cli.action_names import shown
from fibaction.cli.bridge_ends import BridgeEnd
from fibaction.cli.escape import excerpt
from fibaction.cli.exit_codes import message_of
from fibaction.cli.output import note
from fibaction.cli.renames import Renames, clash
from fibaction.exceptions import ActionError, TransportError

LOOKS = 3
"""Looks in which an action must be missing until it counts as gone. A graph of ROS may lose an
action for a moment, and its clients are to notice nothing."""


class _Bridged(NamedTuple):
    """An action that is served by the bridge."""

    info: ActionInfo
    """Its description, with its old name."""
    endpoint: Endpoint
    """Its endpoint, under its new name."""


class BridgedActions:
    """The actions that a bridge serves now."""

    def __init__(self, connection: Connection, renames: Renames, end: BridgeEnd) -> None:
        """Serve actions of a connection at an end."""
        self._connection = connection
        self._renames = renames
        self._end = end
        self._served: dict[str, _Bridged] = {}
        self._missing: dict[str, int] = {}  # the looks since which a served action is missing
        self._unusable: dict[str, ActionInfo] = {}
        self._clashing: set[str] = set()

    @property
    def endpoints(self) -> list[Endpoint]:
        """The endpoints that are served, under their new names."""
        return [one.endpoint for one in self._served.values()]

    async def follow(self) -> None:
        """Look for actions that have come or gone, until canceled."""
        while True:
            await anyio.sleep(PERIOD)
            try:
                infos = await self._connection.actions()
            except ActionError:
                continue  # the server is away; its goals can be followed again when it is back
            before = dict(self._served)
            await self.take(infos)
            for name in self._served.keys() - before.keys():
                new = shown(self._served[name].endpoint.info.name)
                renamed = "" if new == shown(name) else f" as {excerpt(new)}"
                note(f"{excerpt(shown(name))} has come, and is bridged{renamed}")
            for name in before.keys() - self._served.keys():
                note(f"{excerpt(shown(name))} has gone")

    async def take(self, infos: Sequence[ActionInfo]) -> None:
        """Serve these actions from now on; others only until they were missing for some looks."""
        named = {info.name: info for info in infos}
        for known in (self._unusable, self._missing):
            for name in known.keys() - named.keys() - self._served.keys():
                del known[name]
        self._clashing &= named.keys()
        for name in self._served.keys() - named.keys():
            self._missing[name] = self._missing.get(name, 0) + 1
            if self._missing[name] >= LOOKS:
                await self._remove(name)
        for name, info in named.items():
            self._missing.pop(name, None)
            served = self._served.get(name)
            if served is not None and served.info != info:  # with other types
                await self._remove(name)
            if name not in self._served and self._unusable.get(name) != info:
                await self._add(info)

    async def _remove(self, name: str) -> None:
        self._missing.pop(name, None)
        await self._end.remove(self._served.pop(name).endpoint.info.name)

    async def _add(self, info: ActionInfo) -> None:
        name = self._renames.new_name(info.name)
        owner = self._owner_of(name)
        if owner is not None:
            if info.name not in self._clashing:
                note(f"{excerpt(shown(info.name))} is left out: {clash(name, info.name, owner)}")
            self._clashing.add(info.name)
            return
        try:
            endpoint = self._renames.endpoint(self._connection.endpoint(info))
            await self._end.add(endpoint)
        except TransportError as exc:
            self._unusable[info.name] = info
            note(f"{excerpt(shown(info.name))} is left out: {message_of(exc)}")
            return
        self._served[info.name] = _Bridged(info, endpoint)
        self._unusable.pop(info.name, None)
        self._clashing.discard(info.name)

    def _owner_of(self, new: str) -> str | None:
        """Return the old name of the action that is served under a new one; None if none is."""
        return next(
            (old for old, one in self._served.items() if one.endpoint.info.name == new), None
        )
