"""A robot for tests in a browser, with an action at a URL and topics over DDS.

python -m tests.browser.ros_robot URL
"""

from __future__ import annotations

import sys
from collections.abc import AsyncGenerator
from typing import Annotated, Any

import anyio
import msgspec

from fibaction import Action, ActionServer, GoalHandle, serve
from fibaction_transports.ros2 import open_node

CAMERA = "/camera/image"


class Move(msgspec.Struct):
    """The seconds for which to move."""

    seconds: float = 0.5


NAMED = msgspec.Meta(extra_json_schema={"x-topics": [CAMERA]})
MOVE = Action("move", goal=Annotated[Move, NAMED], feedback=int, result=str)


async def move(goal: GoalHandle[Move]) -> AsyncGenerator[Any, None]:
    """Move for some seconds."""
    await anyio.sleep(goal.request.seconds)
    yield "moved"


async def main(url: str) -> None:
    """Serve and publish until the process is ended."""
    async with (
        serve(ActionServer(MOVE, move), url) as (where,),
        open_node("dds://base", arguments=[]) as node,
    ):
        image = node.publisher(CAMERA, "sensor_msgs/msg/Image", qos="sensor_data")
        odom = node.publisher("/odom", "nav_msgs/msg/Odometry")
        print(where, flush=True)
        step = 0
        while True:
            step = (step + 1) % 50
            pixels = bytes([0, 5 * step, 0]) * 64
            image_fields = {"height": 8, "width": 8, "encoding": "rgb8", "step": 24}
            await image.publish({**image_fields, "data": pixels})
            pose = {"position": {"x": step / 10, "y": 1.0}, "orientation": {"w": 1.0}}
            await odom.publish({"header": {"frame_id": "map"}, "pose": {"pose": pose}})
            await anyio.sleep(0.05)


if __name__ == "__main__":
    anyio.run(main, sys.argv[1])
