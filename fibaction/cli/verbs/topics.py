"""`fibaction topic`: the topics of a graph of ROS; and the node of ROS in which such verbs run."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from itertools import pairwise
from typing import Any, Final, TypeVar

import anyio
import click

from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.goal_text import read_yaml
from fibaction.cli.arguments.options import full_option, json_option, url_option
from fibaction.cli.output.escape import printable
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.types.ros_messages import plain_value

TIMEOUT: Final = 5.0
"""Seconds to find what a verb is about."""

FoundT = TypeVar("FoundT")

timeout_option = click.option(
    "--timeout", type=click.FloatRange(0.1), default=TIMEOUT, show_default=True, help="In seconds."
)
all_option = click.option(
    "-a", "--all", "is_all", is_flag=True, help="List those with a hidden name, too."
)
types_option = click.option("-t", "--show-types", is_flag=True, help="Print the types, too.")


@asynccontextmanager
async def node_at(url: str) -> AsyncGenerator[Any, None]:
    """Open a node of ROS, for as long as the block lasts.

    Raises:
        Failure: There is none at this URL, or what the block does is wrong or not answered.
    """
    opener = getattr(transport_for(url), "open_node", None)
    if opener is None:
        raise Failure(
            f"{without_settings(url)} has actions only: topics, services and parameters are at"
            " ros2://, dds:// and zenoh://"
        )
    async with opener() as node:
        try:
            yield node
        except (TimeoutError, ValueError) as exc:
            raise Failure(str(exc)) from exc


async def settled(node: Any, look: Callable[[Any], FoundT]) -> FoundT:
    """Return what is found in the graph of a node once discovery is complete."""
    found: FoundT = await node.settled(look)
    return found


def run_at(url: str, act: Callable[[Any], Awaitable[None]]) -> None:
    """Run something at a node, and exit."""

    async def at_node() -> int:
        async with node_at(url) as node:
            await act(node)
        return ExitCode.SUCCEEDED

    run(at_node)


def say_names(
    found: dict[str, str], kind: str, *, is_all: bool, show_types: bool, as_json: bool
) -> None:
    """Print names with their types, as `ros2 topic list` does: without those that begin with `_`
    at some level, unless all are wanted.
    """
    for name, type_name in sorted(found.items()):
        if "/_" in name and not is_all:
            continue
        if as_json:
            say_json({kind: name, "type": type_name})
        else:
            say(printable(f"{name} [{type_name}]" if show_types else name))


def in_python(message: Any, type_name: str) -> str:
    """Return a message as `ros2` prints it: as Python writes it, with its package."""
    package, text = type_name.rpartition("/")[0].replace("/", "."), repr(message)
    return text if text.startswith(package) else f"{package}.{text}"


WINDOW: Final = 10_000
"""Messages over which `hz` counts, as with ROS."""
PARTING: Final = 0.3
"""Seconds for the last message to leave, and to be sent again if it is lost."""

qos_option = click.option(
    "--qos", default="", help="sensor_data, or words such as best_effort,transient_local."
)


def show(message: Any, *, full: bool, as_json: bool) -> None:
    """Print a message, as `ros2 topic echo` does."""
    if as_json:
        say_json(plain_value(message))
    else:
        say(f"{as_yaml(plain_value(message), full=full)}\n---")


@click.group(
    "topic",
    epilog="""\b
Examples:
  fibaction topic list -u dds://
  fibaction topic echo /odom --once -u zenoh://
  fibaction topic pub /cmd_vel geometry_msgs/msg/Twist "linear: {x: 0.2}" --rate 10 -u dds://""",
)
def topic_command() -> None:
    """List, read and publish topics of ROS, at ros2://, dds:// and zenoh:// URLs."""


@topic_command.command("list")
@types_option
@all_option
@json_option
@url_option
def list_topics(show_types: bool, is_all: bool, as_json: bool, url: str) -> None:
    """List the topics of the graph."""

    async def act(node: Any) -> None:
        found: dict[str, str] = await settled(node, lambda view: dict(view.topics()))
        say_names(found, "topic", is_all=is_all, show_types=show_types, as_json=as_json)

    run_at(url, act)


@topic_command.command("info")
@click.argument("topic")
@click.option("-v", "--verbose", is_flag=True, help="Describe each publisher and subscription.")
@timeout_option
@url_option
def describe_topic(topic: str, verbose: bool, timeout: float, url: str) -> None:
    """Print the type of TOPIC, and who publishes and reads it."""

    async def act(node: Any) -> None:
        type_name = await node.find_type(topic, timeout=timeout)
        name = node.full_name(topic)
        ends: tuple[list[Any], ...] = await settled(
            node, lambda view: (view.publishers(name), view.subscriptions(name))
        )
        say(printable(f"Type: {type_name}"))
        for kind, found in zip(("Publisher", "Subscription"), ends, strict=True):
            say(f"\n{kind} count: {len(found)}" if verbose else f"{kind} count: {len(found)}")
            for end in found if verbose else ():
                say(f"\n{_described(end, kind, type_name)}")

    run_at(url, act)


def _described(end: Any, kind: str, type_name: str) -> str:
    space, _, name = end.node.rpartition("/")
    depth = f" ({end.qos.depth})" if end.qos.history == "keep_last" else ""
    lines = {
        "Node name": name,
        "Node namespace": space or "/",
        "Topic type": type_name,
        "Topic type hash": end.type_hash or "INVALID",
        "Endpoint type": kind.upper(),
        "GID": ".".join(f"{one:02x}" for one in end.gid),
        "QoS profile": "",
        "  Reliability": end.qos.reliability.upper(),
        "  History (Depth)": f"{end.qos.history.upper()}{depth}",
        "  Durability": end.qos.durability.upper(),
        "  Lifespan": _seconds(end.qos.lifespan),
        "  Deadline": _seconds(end.qos.deadline),
        "  Liveliness": end.qos.liveliness.upper(),
        "  Liveliness lease duration": _seconds(end.qos.lease),
    }
    return "\n".join(printable(f"{name}: {value}".rstrip()) for name, value in lines.items())


def _seconds(value: float) -> str:
    return f"{value:g} s" if value < float("inf") else "Infinite"


@topic_command.command("echo")
@click.argument("topic")
@click.option("--once", is_flag=True, help="Print the next message only.")
@qos_option
@timeout_option
@full_option
@json_option
@url_option
def echo_topic(
    topic: str, once: bool, qos: str, timeout: float, full: bool, as_json: bool, url: str
) -> None:
    """Print the messages of TOPIC until Ctrl-C."""

    async def act(node: Any) -> None:
        with await node.follow(topic, qos=qos, depth=100, timeout=timeout) as messages:
            if once:
                show(await messages.next(timeout), full=full, as_json=as_json)
            else:
                await until_interrupted(partial(_echo, messages, full=full, as_json=as_json))

    run_at(url, act)


async def _echo(messages: Any, *, full: bool, as_json: bool) -> None:
    while True:
        show(await messages.next(), full=full, as_json=as_json)


@topic_command.command("hz")
@click.argument("topic")
@qos_option
@timeout_option
@json_option
@url_option
def measure_topic(topic: str, qos: str, timeout: float, as_json: bool, url: str) -> None:
    """Measure how often messages of TOPIC arrive, each second until Ctrl-C."""

    async def act(node: Any) -> None:
        with await node.follow(topic, qos=qos, depth=100, timeout=timeout) as messages:
            await until_interrupted(partial(_measure, messages, as_json=as_json))

    run_at(url, act)


async def _measure(messages: Any, *, as_json: bool) -> None:
    times: deque[float] = deque(maxlen=WINDOW)
    due = time.monotonic() + 1
    while True:
        await messages.next()
        now = time.monotonic()
        times.append(now)
        if now < due or len(times) < 2:
            continue
        due = now + 1
        rate = (len(times) - 1) / (times[-1] - times[0])
        gaps = [later - before for before, later in pairwise(times)]
        least, most, spread = min(gaps), max(gaps), statistics.pstdev(gaps)
        if as_json:
            told = {"rate": rate, "min": least, "max": most, "std_dev": spread}
            say_json(told | {"window": len(times)})
        else:
            say(
                f"average rate: {rate:.3f}\n\tmin: {least:.3f}s max: {most:.3f}s"
                f" std dev: {spread:.5f}s window: {len(times)}"
            )


@topic_command.command("pub")
@click.argument("topic")
@click.argument("type_name", metavar="TYPE")
@click.argument("message", default="")
@click.option("-1", "--once", is_flag=True, help="Publish one message, and exit.")
@click.option("-t", "--times", type=click.IntRange(1), help="Publish so many, and exit.")
@click.option(
    "-r", "--rate", type=click.FloatRange(0.001), default=1.0, help="Messages a second.  [1]"
)
@click.option(
    "-w",
    "--wait-matching-subscriptions",
    "readers",
    type=click.IntRange(0),
    help="Wait for so many readers first.  [1 with --once or --times, else 0]",
)
@qos_option
@timeout_option
@url_option
def publish(
    topic: str,
    type_name: str,
    message: str,
    once: bool,
    times: int | None,
    rate: float,
    readers: int | None,
    **given: Any,
) -> None:
    """Publish MESSAGE, which is YAML, on TOPIC until Ctrl-C."""
    value = read_yaml(message, "message")
    times = 1 if once else times
    wanted = int(times is not None) if readers is None else readers

    async def act(node: Any) -> None:
        with node.publisher(topic, type_name, qos=given["qos"]) as publisher:
            if wanted:
                await publisher.wait_for_reader(given["timeout"], count=wanted)
            await until_interrupted(partial(repeat, publisher))

    async def repeat(publisher: Any) -> None:
        due, number = anyio.current_time(), 0
        while number != times:
            await anyio.sleep_until(due)
            due += 1 / rate
            number += 1
            made = publisher.message(value)
            say(f"publishing #{number}: {in_python(made, type_name)}\n")
            await publisher.publish(made)
        await anyio.sleep(PARTING)

    run_at(given["url"], act)
