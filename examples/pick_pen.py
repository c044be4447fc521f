"""A cancel in practice: an arm is on its way to a pen when the pen rolls off the table.

There are two components in one process. The vision finds the pen, sends the arm there, tracks the
pen while the arm moves, and cancels the goal when the pen is gone. The arm serves the action
`pick`, reports its distance to the target all the way, and cleans up after a cancel.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from typing import NamedTuple

import anyio
from msgspec import Struct

from fibaction import ClientGoal, GoalCanceled, Report, action, connect, serve

URL = "inproc://robot"
FRAME = 1 / 20  # seconds between two frames of the camera
STEP = 0.2  # seconds between two commands to the arm, each of which makes one feedback
SPEED = 0.4  # metres per second, of the gripper
NEAR = 0.001  # metres: the gripper has arrived when it is this close
EDGE = 0.38  # metres from the arm's base to the left edge of the table


class Position(NamedTuple):
    """Metres from the arm's base, which stands on the table: x ahead, y to the left, z up."""

    x: float
    y: float
    z: float

    def __str__(self) -> str:
        return f"({self.x:.2f}, {self.y:.2f}, {self.z:.2f})"


HOME = Position(0.10, 0.00, 0.30)


class Feedback(Struct):
    """The progress of the arm; `distance` is in metres, from the gripper to the target."""

    phase: str
    distance: float


class Result(Struct):
    """The end of a pick; `reached` is how far the gripper got before any retreat, in metres."""

    gripped: bool
    reached: float


class Pen:
    """A pen that lies on the table, and may begin to roll to the left after some seconds."""

    def __init__(self, lies_at: Position, rolls_after: float = math.inf) -> None:
        self._lies_at = lies_at
        self._rolls_at = time.monotonic() + rolls_after

    def look(self) -> Position | None:
        """Return the position of the pen in one frame; None if it is not on the table."""
        rolled = 0.3 * max(0.0, time.monotonic() - self._rolls_at)  # at 0.3 m/s
        position = self._lies_at._replace(y=self._lies_at.y + rolled)
        return position if position.y < EDGE else None


class Arm:
    """The manipulation: a gripper that moves in straight lines and cannot see."""

    def __init__(self, pen: Pen) -> None:
        self._gripper = HOME
        self._pen = pen  # felt by the fingers

    @action
    async def pick(self, report: Report[Feedback], target: Position) -> Result:
        """Move above the target, descend and grip; after a cancel, move home first."""
        way = {"approach": target._replace(z=target.z + 0.1), "descend": target}
        try:
            for phase, place in way.items():
                while math.dist(self._gripper, place) > NEAR:
                    await self._move(place)
                    await report(Feedback(phase, math.dist(self._gripper, target)))
            await anyio.sleep(STEP)  # the fingers close
        except anyio.get_cancelled_exc_class():
            # The cancellation is raised only once, so there is time to clean up.
            reached = round(math.dist(HOME, self._gripper), 2)
            while math.dist(self._gripper, HOME) > NEAR:
                await self._move(HOME)
                await report(Feedback("retreat", math.dist(self._gripper, target)))
            raise GoalCanceled(result=Result(gripped=False, reached=reached)) from None
        return Result(self._pen.look() == target, round(math.dist(HOME, self._gripper), 2))

    async def _move(self, place: Position) -> None:
        await anyio.sleep(STEP)
        share = min(1.0, SPEED * STEP / math.dist(self._gripper, place))
        ways = zip(self._gripper, place, strict=True)
        self._gripper = Position(*(here + share * (there - here) for here, there in ways))


async def track(pen: Pen, place: Position, goal: ClientGoal[Feedback, Result]) -> None:
    """Track the pen, frame by frame, and cancel the goal when the pen is gone."""
    while (seen := pen.look()) is not None:
        if math.dist(seen, place) > 0.05:
            print(f"vision  the pen rolls, it is at {seen}")
            place = seen
        await anyio.sleep(FRAME)
    print("vision  the pen has fallen off the table, cancel")
    await goal.cancel()


async def run(pen: Pen) -> None:
    """Find the pen, send the arm there, and follow both."""
    async with serve(Arm(pen), URL), connect(URL, Arm.pick) as client:
        target = pen.look()
        assert target is not None
        print(f"vision  there is a pen at {target}, pick it")
        async with client.send_goal(target) as goal, anyio.create_task_group() as tasks:
            tasks.start_soon(track, pen, target, goal)
            async for feedback in goal.feedback:
                print(f"arm     {feedback.phase:<9}{feedback.distance:.2f} m from the target")
            tasks.cancel_scope.cancel()
        outcome = await goal.outcome()
        print(f"arm     {outcome.status.name}, {outcome.result}")


async def main() -> None:
    """Pick a pen that lies still, then one that does not."""
    print("The pen lies still.")
    await run(Pen(Position(0.55, 0.20, 0.01)))
    print("\nThe pen rolls away.")
    await run(Pen(Position(0.55, 0.20, 0.01), rolls_after=0.3))


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        anyio.run(main)
