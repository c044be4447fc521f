"""A hundred subscriptions whose publishers are killed again and again, for some minutes.

    python -m tests.soak.peers --seconds 60

One node at `dds://` reads topics of four other processes, each of which has a quarter of them, and
publishes ten times a second. As soon as all topics have arrived, the four are killed, and others
start. After each such round, it notes the memory, tasks, files and threads of the reader. At the
end it fails if memory has grown after the first tenth of the time, or if anything else was more
than after the first round.
"""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import anyio

from fibaction_transports.ros2 import Node, Subscription, open_node
from tests.soak.ends import state
from tests.soak.trial import COUNTED, GROWTH, growth
from tests.support.ros_domain import own_domain
from tests.trials import command_line, seconds

TOPICS, PEERS = 100, 4
PERIOD = 0.1
ROUND = 120.0
"""Seconds for a round, many times as long as one takes."""
STRING = "std_msgs/msg/String"
PEER = "tests.soak.peers"


async def publish(first: int, text: str) -> None:
    """Publish a text on a quarter of the topics until killed."""
    async with open_node(f"dds://peer{first}") as node:
        ends = [node.publisher(f"/t{first + one}", STRING) for one in range(TOPICS // PEERS)]
        while True:
            for end in ends:
                await end.publish({"data": text})
            await anyio.sleep(PERIOD)


@contextmanager
def peers(text: str) -> Generator[None, None, None]:
    """Run publishers of a text for all topics, and kill them."""
    firsts = range(0, TOPICS, TOPICS // PEERS)
    running = [subprocess.Popen([sys.executable, "-m", PEER, str(one), text]) for one in firsts]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


class Reader:
    """Reads all topics, and knows the last message of each."""

    def __init__(self, node: Node) -> None:
        self.messages = 0
        self.subscriptions = [node.subscribe(f"/t{one}", STRING) for one in range(TOPICS)]
        self._last: dict[str, str] = {}
        self._news = anyio.Event()

    async def read(self, subscription: Subscription[Any]) -> None:
        async for message in subscription:
            self.messages += 1
            self._last[subscription.topic] = message.data
            self._news.set()

    async def until(self, text: str) -> None:
        """Wait until this was the last message of all topics."""
        with anyio.fail_after(ROUND):
            while len(self._last) < TOPICS or {*self._last.values()} != {text}:
                self._news = anyio.Event()
                await self._news.wait()


async def run(duration: float, least: int = 1) -> dict[str, Any]:
    """Kill publishers for so many seconds, at least so often, and return what the reader used."""
    samples: list[dict[str, Any]] = []
    async with open_node("dds://reader") as node, anyio.create_task_group() as tasks:
        reader = Reader(node)
        for one in reader.subscriptions:
            tasks.start_soon(reader.read, one)
        end = anyio.current_time() + duration
        while anyio.current_time() < end or len(samples) < least:
            text = str(len(samples))
            with peers(text):
                await reader.until(text)
                samples.append(state())
            if len(samples) % 10 == 0:
                told = f"{len(samples)} rounds, {reader.messages:,} messages: {samples[-1]}"
                print(told, flush=True)
        for one in reader.subscriptions:
            one.close()
    return {"samples": samples, "messages": reader.messages, "kills": PEERS * len(samples)}


def faults(samples: list[dict[str, Any]]) -> list[str]:
    """Return what has grown."""
    found = []
    warm, last = growth([one["memory"] for one in samples]) if len(samples) >= 10 else (0, 0)
    if last > warm * GROWTH:
        found.append(f"the memory has grown from {warm:,} to {last:,} bytes")
    for what in COUNTED:
        first, most = samples[0][what], max(one[what] for one in samples)
        if most > first:
            found.append(f"there were {most} {what}, and {first} after the first round")
    return found


def main(*words: str) -> int:
    parser = command_line(PEER, __doc__)
    parser.add_argument("--seconds", type=seconds, default=600.0, help="default: %(default)g")
    arguments = parser.parse_args(words or None)
    logging.getLogger("fibaction").setLevel(logging.ERROR)  # topics are away for some seconds
    with own_domain():
        report = anyio.run(run, arguments.seconds)
    found = faults(report["samples"])
    told = f"{report['kills']} kills, {report['messages']:,} messages; nothing has grown"
    print(*(found or [told]), sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1].isdigit():
        anyio.run(publish, int(sys.argv[1]), sys.argv[2])
    else:
        sys.exit(main())
