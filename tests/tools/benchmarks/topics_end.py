"""`python -m tests.tools.benchmarks.topics_end stock|fibaction|rclpy|bare`: one end of the topics.

It takes orders as lines of JSON, with a name and a number, and answers each. `stock` publishes and
counts for `fibaction` and `rclpy`, each of which has topics of its own. Two `bare` ones have
neither topics nor ROS: a socket on asyncio, which shows the least that any library takes there.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # one end is asyncio itself
import json
import socket
import sys
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping
from threading import Thread
from typing import Any

import anyio

LARGE = bytes(1_000_000)
PIECES = [*[bytes(63_000)] * 15, b"!" + bytes(54_999)]
"""The same as datagrams, of which the last one counts."""
PERIODS = {"small": 0.001, "flood": 0.0, "large": 1 / 30}
"""The seconds between two messages."""
CONTENDERS = ("fibaction", "rclpy")
SMALL_TYPE, LARGE_TYPE = "geometry_msgs/msg/Twist", "std_msgs/msg/UInt8MultiArray"


DEPTH = 10_000


class Heard:
    """The number of messages that have arrived, and the seconds from the first to the last."""

    def __init__(self) -> None:
        self._count = 0
        self._first = self._last = 0.0

    def note(self, message: object) -> None:
        self._last = time.perf_counter()
        self._first = self._first if self._count else self._last
        self._count += 1

    def taken(self) -> tuple[int, float]:
        """Return both, and begin anew."""
        found = self._count, self._last - self._first
        self._count = 0
        return found


def say(value: object) -> None:
    print(json.dumps(value), flush=True)


def ticks(times: int, period: float) -> Iterable[float]:
    """Yield so many times the seconds until the next message is due."""
    due = time.perf_counter()
    for _ in range(times):
        due += period
        yield max(0.0, due - time.perf_counter())


async def messages(heard: Mapping[str, Heard]) -> AsyncGenerator[tuple[str, str, float], None]:
    """Carry out the orders; yield each message that is due, with its contender and the seconds that
    are left until then, and for `to` the port of the other end in their place.
    """
    read: Callable[[], str] = sys.stdin.readline
    while line := await anyio.to_thread.run_sync(read, abandon_on_cancel=True):
        order = json.loads(line)
        what, _, name = order["do"].partition(" ")
        if what == "heard":
            say(heard[name].taken())
            continue
        waits = [order["times"]] if what == "to" else ticks(order["times"], PERIODS[what])
        for wait in waits:
            yield what, name, wait
        say("done")


async def stock(*names: str) -> None:
    """Publish for, and hear, each of these; one of them is what this is measured as."""
    import rclpy
    from geometry_msgs.msg import Twist
    from rclpy.executors import SingleThreadedExecutor
    from std_msgs.msg import UInt8MultiArray

    rclpy.init()
    is_peer = len(names) > 1
    node = rclpy.create_node("benchmark_peer" if is_peer else "benchmark_rclpy")
    to, back = ("to", "from") if is_peer else ("from", "to")
    small, large, heard = {}, {}, {name: Heard() for name in names}
    for name in names:
        small[name] = node.create_publisher(Twist, f"{to}_{name}", DEPTH)
        large[name] = node.create_publisher(UInt8MultiArray, f"large_{to}_{name}", 10)
        node.create_subscription(Twist, f"{back}_{name}", heard[name].note, DEPTH)
        node.create_subscription(UInt8MultiArray, f"large_{back}_{name}", heard[name].note, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    Thread(target=executor.spin, daemon=True).start()
    say("ready")
    async for what, name, wait in messages(heard):
        if wait:
            time.sleep(wait)  # noqa: ASYNC251, TID251  # programs of rclpy block
        if what == "large":
            large[name].publish(UInt8MultiArray(data=LARGE))
        else:
            twist = Twist()
            twist.linear.x = wait
            small[name].publish(twist)


async def ours(name: str) -> None:
    """The same with fibaction."""
    from fibaction_transports.ros2 import Subscription, open_node

    heard = Heard()

    async def hear(subscription: Subscription[Any]) -> None:
        async for message in subscription:
            heard.note(message)

    async with (
        open_node("dds://benchmark_fibaction") as node,
        anyio.create_task_group() as tasks,
    ):
        small = node.publisher(f"from_{name}", SMALL_TYPE, depth=DEPTH)
        large = node.publisher(f"large_from_{name}", LARGE_TYPE)
        tasks.start_soon(hear, node.subscribe(f"to_{name}", SMALL_TYPE, depth=DEPTH))
        tasks.start_soon(hear, node.subscribe(f"large_to_{name}", LARGE_TYPE))
        say("ready")
        async for what, _, wait in messages({name: heard}):
            if wait:
                await anyio.sleep(wait)
            if what == "large":
                await large.publish({"data": LARGE})
            else:
                await small.publish({"linear": {"x": wait}})
        tasks.cancel_scope.cancel()


async def bare(name: str) -> None:
    """Send and count datagrams, with nothing but a socket and the event loop."""
    heard, loop = Heard(), asyncio.get_running_loop()

    def hear() -> None:
        datagram = own.recv(2**16)
        if datagram.startswith(b"!"):
            heard.note(datagram)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        own.bind(("127.0.0.1", 0))
        own.setblocking(False)
        loop.add_reader(own, hear)
        say(own.getsockname()[1])
        port = 0
        async for what, _, wait in messages({name: heard}):
            if what == "to":
                port = int(wait)
                continue
            if wait:
                await anyio.sleep(wait)
            for datagram in PIECES if what == "large" else [b"!" + bytes(51)]:
                own.sendto(datagram, ("127.0.0.1", port))
        loop.remove_reader(own)


if __name__ == "__main__":
    end = sys.argv[1]
    if end == "fibaction":
        anyio.run(ours, end)
    elif end.startswith("bare"):
        anyio.run(bare, "bare")
    else:
        anyio.run(stock, *(CONTENDERS if end == "stock" else [end]))
