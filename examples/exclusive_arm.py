"""An arm that moves to its newest target: a new goal preempts the one before it.

The arm brakes first, and the preempted goal ends as ABORTED, with the angles at which the joints
have stopped. Then the new goal begins. A goal that is rejected preempts nothing.

Without arguments, a camera sees a cup that is carried around, and sends the arm there. With
`--url`, the arm is served there until Ctrl-C or SIGTERM: at `ros2://`, it is an action server of
ROS 2.

Exit codes: 0 the program has ended or was stopped, 2 the command line or the URL is invalid.
"""

from __future__ import annotations

import argparse
import logging
import math
from collections.abc import Iterable
from contextlib import suppress
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
from anyio import TASK_STATUS_IGNORED
from anyio.abc import TaskStatus
from msgspec import Struct

from fibaction import (
    ActionClient,
    ActionServer,
    GoalCanceled,
    GoalRejected,
    Report,
    Schedule,
    TransportError,
    action,
    connect,
    serve,
)

HERE = "inproc://arm"
STEP = 0.1  # seconds between two commands to the joints, each of which makes one feedback
SPEED = 1.0  # radians per second, of each joint
BRAKING = (0.5, 0.2)  # parts of the speed, for one step each
RANGE = math.pi / 2  # radians: the joints turn so far to both sides
SIGHTINGS = {
    "table": (0.60, 0.30, -0.20),
    "shelf": (-0.40, 0.60, 0.30),
    "moon": (0.00, 3.00, 0.00),
}
PATIENCE = 4  # feedback messages after which the cup is carried on


class Goal(Struct):
    """A request to turn the three joints to these angles, in radians."""

    joints: list[float]


class Feedback(Struct):
    """The progress of the arm: it `moves` or it `brakes`, and its joints have these angles."""

    phase: str
    joints: list[float]


class Result(Struct):
    """The angles at the end, also if the arm was stopped on its way."""

    joints: list[float]


NEWEST_ONLY = Schedule(concurrency=1, when_full="preempt")


class Arm:
    """The three joints of the arm, which one goal at a time may move."""

    def __init__(self) -> None:
        self.joints = [0.0, 0.0, 0.0]

    def on_goal(self, goal: Goal) -> None:
        """Accept angles that the joints can have. Only an accepted goal preempts.

        Raises:
            GoalRejected: There are too few or too many angles, or a joint cannot turn so far.
        """
        if len(goal.joints) != len(self.joints):
            raise GoalRejected(f"the arm has {len(self.joints)} joints, not {len(goal.joints)}")
        for angle in goal.joints:
            if not abs(angle) <= RANGE:
                raise GoalRejected(f"a joint cannot turn to {angle:.2f}, only to +-{RANGE:.2f}")

    @action("move_arm", type_name="arduinobot_msgs/action/MoveArm")
    async def move(self, report: Report[Feedback], goal: Goal) -> Result:
        """Turn all joints to their angles; brake if the goal is preempted or canceled."""
        target = goal.joints
        try:
            while self.joints != target:
                await self._turn(target)
                await report(Feedback("moves", self.joints))
        except anyio.get_cancelled_exc_class():
            # The next goal begins only after this clean-up, so the joints have one master.
            for part in BRAKING:
                await self._turn(target, part)
                await report(Feedback("brakes", self.joints))
            raise GoalCanceled(result=Result(self.joints)) from None
        return Result(self.joints)

    async def _turn(self, target: list[float], part: float = 1.0) -> None:
        await anyio.sleep(STEP)
        most = part * SPEED * STEP
        self.joints = [
            end if abs(end - angle) <= most else angle + math.copysign(most, end - angle)
            for angle, end in zip(self.joints, target, strict=True)
        ]


def make_server() -> ActionServer[Any, Feedback, Result]:
    """Return a server of a new arm."""
    arm = Arm()
    return ActionServer(arm.move, on_goal=arm.on_goal, schedule=NEWEST_ONLY)


async def demo() -> None:
    """Serve an arm, and send it after a cup."""
    async with (
        serve(make_server(), HERE),
        connect(HERE, Arm.move) as client,
        anyio.create_task_group() as tasks,
    ):
        for place, joints in SIGHTINGS.items():
            await tasks.start(send_arm, client, place, joints)


async def send_arm(
    client: ActionClient[Any, Feedback, Result],
    place: str,
    joints: Iterable[float],
    *,
    task_status: TaskStatus[None] = TASK_STATUS_IGNORED,
) -> None:
    """Send the arm to a place, and print its way; the cup is carried on after a while."""
    print(f"camera  the cup is at the {place}: move to {angles(joints)}")
    try:
        async with client.send_goal(Goal(list(joints))) as goal:
            print(f"{place:<8}accepted as {goal.goal_id}")
            steps = 0
            async for feedback in goal.feedback:
                print(f"{place:<8}{feedback.phase:<8}{angles(feedback.joints)}")
                steps += 1
                if steps == PATIENCE:
                    task_status.started()
            outcome = await goal.outcome()
    except GoalRejected as exc:
        print(f"{place:<8}REJECTED: {exc.reason}")
        task_status.started()
    else:
        assert outcome.result is not None
        end = f"{outcome.status.name} at {angles(outcome.result.joints)}"
        print(f"{place:<8}{end}{outcome.reason and f': {outcome.reason}'}")


def angles(joints: Iterable[float]) -> str:
    """Return the angles as text."""
    return " ".join(f"{angle:5.2f}" for angle in joints)


async def serve_at(url: str) -> None:
    """Serve an arm until a signal arrives, then brake, and end the goals.

    Raises:
        TransportError: The URL is invalid or cannot be served at.
    """
    with anyio.open_signal_receiver(SIGINT, SIGTERM) as signals:
        async with serve(make_server(), url) as (where,):
            print(f"serving {Arm.move.name} at {where}, Ctrl-C stops it", flush=True)
            await anext(signals)


if __name__ == "__main__":
    # Without a usage, an error is one line; --help still lists the options.
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--url", help="URL to serve at (default: a demonstration in one process)")
    arguments = parser.parse_args()
    try:
        if arguments.url is None:
            with suppress(KeyboardInterrupt):
                anyio.run(demo)
        else:
            logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
            anyio.run(serve_at, arguments.url)
    except TransportError as exc:
        parser.error(str(exc))
