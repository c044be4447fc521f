"""`FleetDispatcher`: carries out a schedule whose limit all workers of a fleet have together.

It is a `GoalDispatcher` on a `FleetScheduler`. Keys are compared with those of other processes, so
they are made into bytes.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
from anyio import current_time

from fibaction._runtime.text import excerpt
from fibaction.border.goal_store import KeyPlaces, OpenKeyPlaces
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.scheduling.fleet_scheduler import FleetScheduler
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.server.scheduling.schedule import Schedule
from fibaction.server.scheduling.shared_scheduler import Member, SharedScheduler
from fibaction.types.action import GoalT


def dispatcher_of(action: str, schedule: Schedule | None, kill_after: float) -> Dispatcher[GoalT]:
    """Return what carries out a schedule, if there is one, for the goals of an action."""
    if schedule is None:
        return Dispatcher()
    if schedule.fleet_limit:
        return FleetDispatcher(schedule, action=action, kill_after=kill_after)
    return GoalDispatcher(schedule, action=action, kill_after=kill_after)


class FleetDispatcher(GoalDispatcher[GoalT]):
    """The schedule of one worker at work."""

    def __init__(self, schedule: Schedule, *, action: str, kill_after: float) -> None:
        super().__init__(schedule, action=action, kill_after=kill_after)
        self._as_key = portable

    async def _join(self, key_places: OpenKeyPlaces) -> SharedScheduler:
        schedule = self._schedule
        assert schedule.concurrency is not None
        places = await key_places(schedule.fleet_limit, schedule.concurrency)
        shared = SharedFleetScheduler.join(schedule, self, places)
        if not shared.uses(places):
            shared.quit(self, current_time())
            raise ValueError(
                f"servers that share a schedule with fleet_limit={schedule.fleet_limit!r} are"
                f" served by one worker: give each worker a Schedule of its own"
            )
        return shared


class SharedFleetScheduler(SharedScheduler):
    """The scheduler of all servers of one worker that have the same schedule."""

    def __init__(self, schedule: Schedule, kill_after: float, places: KeyPlaces) -> None:
        super().__init__(schedule, kill_after)
        self._fleet = FleetScheduler(schedule, places, kill_after=kill_after)
        self.scheduler = self._fleet
        places.open(self._granted)

    def uses(self, places: KeyPlaces) -> bool:
        """Return whether it starts goals by these places."""
        return self._fleet.key_places is places

    def _granted(self, key: bytes) -> None:
        self.carry_out(self._fleet.granted(key, current_time()))

    def quit(self, member: Member, now: float) -> None:
        super().quit(member, now)
        if self.is_empty:
            self._fleet.key_places.close()


def portable(key: Any) -> bytes:
    """Return a key as bytes, which are the same in each process.

    Raises:
        TypeError, ValueError: It cannot be, or it is not equal to itself.
    """
    if isinstance(key, float) and math.isnan(key):
        raise ValueError("it returned nan, which is not equal to itself")
    try:
        return msgspec.msgpack.encode(key, order="deterministic")
    except (TypeError, ValueError, OverflowError) as exc:
        raise TypeError(
            f"it returned {excerpt(repr(key))}, and a key for a fleet is a text, a number, or a"
            f" tuple of them"
        ) from exc
