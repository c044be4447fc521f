"""The way in which a server takes new goals: as operators have set it, `Levers`, and as many as it
can, `Capacity`.

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
from fibaction._runtime.notify import Notifier
from fibaction.words.errors import ServerFailed, StoreError
from fibaction.words.intake import OPEN_INTAKE, Intake, IntakeChange, IntakeMode

if TYPE_CHECKING:
    from anyio.abc import TaskGroup

    from fibaction.server.admission.admission import Admission
    from fibaction.server.durability.keeper import Keeper
    from fibaction.server.execution.runs import Runs
    from fibaction.server.registry.registry import GoalRegistry
    from fibaction.server.scheduling.dispatcher import Dispatcher
    from fibaction.words.intake import ScheduleInfo


LOOK_AGAIN = 0.1
"""Seconds after which a server that holds too many bytes looks again."""
MEANINGS = {
    IntakeMode.OPEN: "takes goals again",
    IntakeMode.HOLD: "is paused, and new goals wait",
    IntakeMode.REFUSE: "is paused, and new goals are rejected",
    IntakeMode.DRAIN: "drains: new goals are rejected, and the others run to their ends",
}
logger = clean_logger("fibaction.server")


class Capacity:
    """The number of goals that a server can take in addition, as its store is told.

    A store that several servers share hands goals over by it. It is computed from counters at each
    write of the server, at each answer, and when a goal leaves the schedule, and told when one of
    the two numbers becomes zero, or more than zero. Bytes are given back by readers, of which
    nothing is told, so a server that has too many looks again after a while.
    """

    def __init__(
        self,
        registry: GoalRegistry,
        keeper: Keeper,
        dispatcher: Dispatcher[Any],
        runs: Runs[Any, Any, Any],
    ) -> None:
        self._registry = registry
        self._keeper = keeper
        self._dispatcher = dispatcher
        self._runs = runs
        self._is_open = False
        self._told = False, False
        self._shortage = Notifier()

    def open(self) -> None:
        """Tell the store from now on what the server can take: it runs."""
        self._is_open = True
        self.update()

    def close(self) -> None:
        """Tell the store that the server takes no more goals: it drains, or stops."""
        self._is_open = False
        self.update()

    def update(self) -> None:
        """Tell the store if one of the numbers has become zero, or more than zero."""
        running, waiting = 0.0, 0.0
        if self._is_open:
            if self._registry.goals_left > 0:
                running, waiting = self._dispatcher.capacity()
                if self._registry.intake.holds or self._runs.suspects.goals:
                    running, waiting = 0.0, max(waiting, 1.0)
            elif self._registry.has_too_many_bytes:
                self._shortage.notify()
        has_room = running > 0, waiting > 0
        if has_room != self._told:
            self._told = has_room
            self._keeper.set_capacity(running, waiting)

    def watch(self, tasks: TaskGroup) -> None:
        """Look again after a shortage of bytes, in a task of this group."""
        tasks.start_soon(self._run, name="room for goals")

    async def _run(self) -> None:
        while True:
            while not (self._is_open and self._registry.has_too_many_bytes):
                await self._shortage.wait()
            await sleep(LOOK_AGAIN)
            self.update()


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
        schedule: ScheduleInfo,
    ) -> None:
        """Tell the `schedule` with each intake."""
        self._schedule = schedule
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
        mode = IntakeMode.DRAIN if self._is_draining else self._intake.mode
        return replace(self._intake, mode=mode, schedule=self._schedule)

    def _failure(self, error: StoreError) -> ServerFailed:
        logger.error("the intake of action server %r: %s", self._action, error)
        return ServerFailed("the server cannot keep or read how it takes goals")
