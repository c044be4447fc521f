"""A robot that drives, for agents of any protocol."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator

import anyio
import msgspec

from fibaction import (
    Action,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalHandle,
    GoalRejected,
)
from fibaction_transports.inprocess import InProcessTransport


class Drive(msgspec.Struct):
    """Drive straight on."""

    meters: int
    speed: float = 0.5


class Driven(msgspec.Struct):
    meters: int


class Arrived(msgspec.Struct):
    at: int


DRIVE = Action("arm/drive", goal=Drive, feedback=Driven, result=Arrived, type_name="a/action/Drive")


class DrivingRobot:
    """A robot that drives meter by meter, as `_meters` says."""

    def __init__(self) -> None:
        self.here = InProcessTransport()
        self.sent: list[Drive] = []
        """The goals that were accepted."""
        self.stopped = anyio.Event()
        """Set when a drive was canceled."""
        self.is_stubborn = False
        self.drive = ActionServer(
            DRIVE, self._drive, on_goal=self._on_drive, on_cancel=self._on_cancel, result_timeout=60
        )

    def _meters(self, meters: int) -> AsyncIterator[int]:
        raise NotImplementedError

    def _on_drive(self, goal: Drive) -> None:
        if goal.meters < 0:
            raise GoalRejected("it cannot drive backwards" if goal.meters > -9 else "")
        self.sent.append(goal)

    def _on_cancel(self, _: GoalHandle[Drive]) -> None:
        if self.is_stubborn:
            raise CancelRejected("it is on a slope")

    async def _drive(self, goal: GoalHandle[Drive]) -> AsyncGenerator[Driven | Arrived, None]:
        meters = goal.request.meters
        if meters == 13:
            raise GoalAborted("there is a wall", result=Arrived(12))
        try:
            async for meter in self._meters(meters):
                yield Driven(meter)
        except anyio.get_cancelled_exc_class():
            self.stopped.set()
            raise GoalCanceled("it has braked", result=Arrived(1)) from None
        yield Arrived(meters)
