"""`python -m tests.tools.benchmarks.dds_once once NAME`: a whole program of a client at `dds://`.

It sends one goal, and prints the time of the result and its memory. It imports what such a program
needs, and so no server.
"""

from __future__ import annotations

import sys
from time import time

import anyio
import msgspec

from fibaction import Action, connect
from tests.tools.benchmarks.ros2_orders import most_memory


class Goal(msgspec.Struct):
    order: int


class Feedback(msgspec.Struct):
    partial_sequence: list[int]


class Result(msgspec.Struct):
    sequence: list[int]


async def main(name: str) -> None:
    action = Action(
        name,
        goal=Goal,
        feedback=Feedback,
        result=Result,
        type_name="arduinobot_msgs/action/Fibonacci",
    )
    async with connect("dds://benchmark_once", action) as client:
        await client.call(Goal(0))
        print([time(), most_memory()], flush=True)


if __name__ == "__main__":
    anyio.run(main, sys.argv[2])
    if {"rclpy", "fibaction.server"} & sys.modules.keys():
        raise SystemExit("rclpy or the server of fibaction was imported")
