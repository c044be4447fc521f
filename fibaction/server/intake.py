"""`Levers`: the way in which a server takes new goals, as operators have set it.

A pause is kept by the store of the server. Of a store that several servers share, another one may
have kept a newer one, so it is looked at again after a while, and when somebody asks. To drain is
about this server alone, and is noted among the changes only.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import msgspec
from anyio import CancelScope, sleep
from anyio.lowlevel import RunVar
from msgspec.structs import replace

from fibaction._runtime.log import clean_logger
from fibaction.words.errors import ServerFailed, StoreError
from fibaction.words.intake import OPEN_INTAKE, Intake, IntakeChange, IntakeMode

if TYPE_CHECKING:
    from fibaction.server.admission.admission import Admission
    from fibaction.server.capacity import Capacity
    from fibaction.server.durability.keeper import Keeper
    from fibaction.server.execution.runs import Runs
    from fibaction.server.registry.registry import GoalRegistry

MEANINGS = {
    IntakeMode.OPEN: "takes goals again",
    IntakeMode.HOLD: "is paused, and new goals wait",
    IntakeMode.REFUSE: "is paused, and new goals are rejected",
    IntakeMode.DRAIN: "drains: new goals are rejected, and the others run to their ends",
}

logger = clean_logger("fibaction.server")


_goals_here = RunVar[WeakSet["GoalRegistry"]]("_goals_here")


def goals_here() -> WeakSet[GoalRegistry]:
    """Return the goals of all servers of this event loop: a drain waits for their steps, too."""
    found = _goals_here.get(None)
    if found is None:
        found = WeakSet["GoalRegistry"]()
        _goals_here.set(found)
    return found


class Levers:
    """The levers of one server."""

    def __init__(
        self,
        action: str,
        registry: GoalRegistry,
        keeper: Keeper,
        runs: Runs[Any, Any, Any],
        admission: Admission[Any, Any, Any],
        capacity: Capacity,
    ) -> None:
        self._action = action
        self._rule = registry.intake
        self._keeper = keeper
        self._runs = runs
        self._admission = admission
        self._capacity = capacity
        self._kept = b""
        self._intake = OPEN_INTAKE
        self._is_draining = False
        self._is_final = False
        self._goals_here = goals_here()
        self._goals_here.add(registry)

    def finish(self) -> None:
        """Let no operator end a drain from now on: the server itself drains or stops."""
        self._is_final = True

    async def look(self) -> Intake:
        """Return the intake, after a look at what the store has.

        Raises:
            ServerFailed: It cannot be read.
        """
        try:
            await self._follow(await self._keeper.intakes.intake())
        except StoreError as exc:
            raise self._failure(exc) from exc
        return self._told()

    async def watch(self) -> None:
        """Look again and again at a store that other servers share."""
        while True:
            await sleep(self._keeper.intakes.intake_period)
            try:
                await self._follow(await self._keeper.intakes.intake())
            except StoreError as exc:
                logger.debug("the intake of action %r cannot be read: %s", self._action, exc)

    async def change(self, change: IntakeChange) -> Intake:
        """Change the intake, once that is kept, and return it. A drain ends before a pause does.

        What is kept is followed at once, even if the caller has left meanwhile.

        Raises:
            ServerFailed: It cannot be kept.
        """
        with CancelScope(shield=True):
            await self._change(change)
        return self._told()

    async def _change(self, change: IntakeChange) -> None:
        change = replace(change, at=time.time_ns())
        drains = change.mode is IntakeMode.DRAIN
        undrains = self._is_draining and change.mode is IntakeMode.OPEN and not self._is_final
        if drains and self._is_draining:
            return
        try:
            kept = await self._keeper.intakes.change_intake(
                lambda kept: self._encoded(kept, change, is_noted=undrains)
            )
        except StoreError as exc:
            raise self._failure(exc) from exc
        if drains:
            self._is_draining = True
            self._admission.drain(tuple(self._goals_here))
            self._capacity.close()
        elif undrains:
            self._is_draining = False
            self._admission.end_drain()
            self._capacity.open()
        if drains or undrains or kept != self._kept:
            by = f" (by {change.by})" if change.by else ""
            reason = f": {change.reason}" if change.reason else ""
            logger.warning("action %r %s%s%s", self._action, MEANINGS[change.mode], by, reason)
        await self._follow(kept)

    def _encoded(self, kept: bytes, change: IntakeChange, *, is_noted: bool) -> bytes:
        """Return what is to be kept in place of `kept`; a change may only be noted."""
        before = self._decoded(kept)
        after = before.changed(change, is_noted=is_noted)
        return kept if after is before else msgspec.msgpack.encode(after)

    def _decoded(self, kept: bytes) -> Intake:
        if not kept:
            return OPEN_INTAKE
        try:
            return msgspec.msgpack.decode(kept, type=Intake)
        except msgspec.MsgspecError as exc:
            logger.error("action %r: its intake cannot be read, and is open: %s", self._action, exc)
            return OPEN_INTAKE

    async def _follow(self, kept: bytes) -> None:
        if kept != self._kept:
            self._kept = kept
            self._intake = self._decoded(kept)
            self._rule.follow(self._intake)
            self._capacity.update()
            await self._runs.follow_intake()

    def _told(self) -> Intake:
        return replace(self._intake, mode=IntakeMode.DRAIN) if self._is_draining else self._intake

    def _failure(self, error: StoreError) -> ServerFailed:
        logger.error("the intake of action server %r: %s", self._action, error)
        return ServerFailed("the server cannot keep or read how it takes goals")
