"""The actions of one side of a bridge, as they come and go."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import anyio

from fibaction.border.abc import Absence, Connection, Endpoint
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.bridge.ends import BridgeEnd
from fibaction.cli.bridge.renames import Renames, clash
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import message_of
from fibaction.observe.action_listener import PERIOD
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ActionError, TransportError

LOOKS = 3
"""Consecutive looks without an action after which it counts as gone. A graph of ROS may lose an
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
        self._owners: dict[str, str] = {}  # the old names of what is served, by the new ones
        self._missing: dict[str, int] = {}  # the looks since which a served action is missing
        self._unusable: dict[str, ActionInfo] = {}
        self._clashing: set[str] = set()
        self.absence: Absence | None = None
        """The time in which the server does not say which actions it has."""

    @property
    def endpoints(self) -> list[Endpoint]:
        """The endpoints that are served, under their new names."""
        return [one.endpoint for one in self._served.values()]

    async def follow(self, period: float = PERIOD) -> None:
        """Look for actions that have come or gone, until canceled."""
        while True:
            await anyio.sleep(period)
            await self.look()

    async def look(self) -> None:
        """Serve what has come, and stop serving what has gone."""
        try:
            infos = await self._connection.actions()
        except ActionError as exc:
            # The server is away; its goals can be followed again when it is back.
            since = self.absence.since if self.absence else time.time()
            self.absence = Absence(since, str(exc))
            return
        self.absence = None
        before = dict(self._served)
        await self.take(infos)
        self._tell_changes(before)

    def _tell_changes(self, before: Mapping[str, _Bridged]) -> None:
        for name in before:
            if name not in self._served:
                note(f"{excerpt(shown(name))} has gone")
        for name, one in self._served.items():
            if one is before.get(name):
                continue
            new = shown(one.endpoint.info.name)
            renamed = "" if new == shown(name) else f" as {excerpt(new)}"
            types = " with other types" if name in before else ""
            note(f"{excerpt(shown(name))} has come{types}, and is served{renamed}")

    async def take(self, infos: Sequence[ActionInfo]) -> None:
        """Serve these actions from now on, and stop serving others that are missing for long."""
        named = {info.name: info for info in infos}
        for name in self._unusable.keys() - named.keys():
            del self._unusable[name]
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
        new = self._served.pop(name).endpoint.info.name
        del self._owners[new]
        await self._end.remove(new)

    async def _add(self, info: ActionInfo) -> None:
        name = self._renames.new_name(info.name)
        owner = self._owners.get(name)
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
        self._owners[endpoint.info.name] = info.name
        self._unusable.pop(info.name, None)
        self._clashing.discard(info.name)
