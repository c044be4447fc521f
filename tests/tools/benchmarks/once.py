"""`python -m tests.tools.benchmarks.once fibaction|rclpy NAME`: a whole program of a client.

It sends one goal over DDS, and prints the time of the result and its memory. It imports what such a
program needs, and so no server.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from time import time


def ours(name: str) -> None:
    import anyio
    import msgspec

    from fibaction import Action, connect

    goal = msgspec.defstruct("Goal", [("order", int)])
    action = Action(
        name,
        goal=goal,
        feedback=msgspec.defstruct("Feedback", [("partial_sequence", list[int])]),
        result=msgspec.defstruct("Result", [("sequence", list[int])]),
        type_name="arduinobot_msgs/action/Fibonacci",
    )

    async def main() -> None:
        async with connect("dds://benchmark_once", action) as client:
            await client.call(goal(0))
            tell()

    anyio.run(main)
    if {"rclpy", "fibaction.server"} & sys.modules.keys():
        raise SystemExit("rclpy or the server of fibaction was imported")


def stock(name: str) -> None:
    import rclpy
    from arduinobot_msgs.action import Fibonacci
    from rclpy.action import ActionClient

    rclpy.init()
    node = rclpy.create_node("benchmark_once")
    client = ActionClient(node, Fibonacci, name)
    client.wait_for_server()
    sent = client.send_goal_async(Fibonacci.Goal())
    rclpy.spin_until_future_complete(node, sent)
    rclpy.spin_until_future_complete(node, sent.result().get_result_async())
    tell()


def tell() -> None:
    """Print the time, and the largest memory of this program until now, in bytes.

    The usage that `wait4` returns is at least that of the program that started it.
    """
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    size = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
    print(json.dumps([time(), size]), flush=True)


if __name__ == "__main__":
    {"fibaction": ours, "rclpy": stock}[sys.argv[1]](sys.argv[2])
