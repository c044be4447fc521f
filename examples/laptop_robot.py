"""A robot from a laptop without ROS: an arm on ROS 2 is moved, and stopped half-way.

The arm is a node with an action server, which is found and used by every node of ROS 2, and by
`ros2 action`. It is a part of this program, so that it runs anywhere; with `--laptop` only the
laptop's half runs, and moves an arm in the network. Neither half needs ROS: both speak DDS, and
have the type of the action from its interface file.

Exit codes: 0 the arm has moved and stopped, 2 the command line is invalid.
"""

from __future__ import annotations

import argparse
import asyncio
from contextlib import AsyncExitStack
from pathlib import Path

import anyio
from msgspec import Struct

from fibaction import GoalCanceled, Report, action, connect, serve
from fibaction.action_files import load_action

INTERFACES = Path(__file__).parent / "ros2"
ROBOT = f"dds://arm?discovery=LOCALHOST&search={INTERFACES}"

# The robot


class Joints(Struct):
    """The angle of each joint, in radians."""

    joints: list[float]


class Moving(Struct):
    """The angles on the way."""

    phase: str
    joints: list[float]


@action(type_name="arduinobot_msgs/action/MoveArm")
async def move_arm(report: Report[Moving], goal: Joints) -> Joints:
    """Move all joints at once, in ten parts."""
    joints = [0.0] * len(goal.joints)
    try:
        for part in range(1, 11):
            joints = [round(angle * part / 10, 3) for angle in goal.joints]
            await report(Moving("moves", joints))
            await anyio.sleep(0.2)
    except asyncio.CancelledError:
        raise GoalCanceled(result=Joints(joints)) from None  # the brakes are on
    return Joints(joints)


# The laptop


async def move_and_stop(url: str) -> None:
    """Move the arm, then send it somewhere else, and stop it on the way."""
    move = load_action(INTERFACES / "arduinobot_msgs/action/MoveArm.action", name="move_arm")
    async with connect(url, move) as arm:
        await arm.wait_for_server()
        result = await arm.call(move.goal.type(joints=[0.5, -1.0]))
        print("moved to", result.joints)
        async with arm.send_goal(move.goal.type(joints=[2.0, 0.0])) as goal:
            async for moving in goal.feedback:
                print("at", moving.joints)
                if moving.joints[0] > 0.5:
                    await goal.cancel()
            outcome = await goal.outcome()
        assert outcome.result is not None
        print(outcome.status.name, "at", outcome.result.joints)


async def main(*, with_robot: bool) -> None:
    """Run the laptop's half, and the robot's if it is to be here."""
    async with AsyncExitStack() as stack:
        if with_robot:
            await stack.enter_async_context(serve(move_arm, ROBOT))
        await move_and_stop(f"dds://laptop?discovery={'LOCALHOST' if with_robot else 'SUBNET'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--laptop", action="store_true", help="move an arm that is in the network")
    anyio.run(lambda: main(with_robot=not parser.parse_args().laptop))
