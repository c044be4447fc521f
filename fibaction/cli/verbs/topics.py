"""`fibaction topic`, `service` and `param`: what a graph of ROS has beside actions, without ROS."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any, Final

import anyio
import click
import msgspec

from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.goal_input import read_goal
from fibaction.cli.arguments.options import full_option, json_option, url_option
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.output.yaml_text import as_yaml
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.process.signals import until_interrupted
from fibaction.types.ros_messages import encode

TIMEOUT: Final = 5.0
"""Seconds to find what a verb is about."""
LISTENED: Final = 1.0
"""Seconds in which a list of topics is made, at least."""
SETTLED: Final = 0.3
"""Seconds without a new topic after which a list is whole."""
WINDOW: Final = 1_000
"""Messages over which `hz` counts."""

qos_option = click.option(
    "--qos", default="", help="sensor_data, or words such as best_effort,transient_local."
)
timeout_option = click.option(
    "--timeout", type=click.FloatRange(0.1), default=TIMEOUT, show_default=True, help="In seconds."
)


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


def plain(message: Any) -> Any:
    """Return a message of ROS as plain data."""
    return msgspec.msgpack.decode(encode(message))


def show(message: Any, *, full: bool, as_json: bool) -> None:
    """Print a message, as `ros2 topic echo` does."""
    if as_json:
        say_json(plain(message))
    else:
        say(f"{as_yaml(plain(message), full=full)}\n---")


def run_at(url: str, act: Callable[[Any], Awaitable[None]]) -> None:
    """Run something at a node, and exit."""

    async def at_node() -> int:
        async with node_at(url) as node:
            await act(node)
        return ExitCode.SUCCEEDED

    run(at_node)


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
@json_option
@url_option
def list_topics(as_json: bool, url: str) -> None:
    """List the topics of the graph with their types."""

    async def act(node: Any) -> None:
        seen: dict[str, str] = {}
        quiet = anyio.current_time() + LISTENED
        while anyio.current_time() < quiet:
            found = node.topics()
            if len(found) > len(seen):
                seen, quiet = found, max(quiet, anyio.current_time() + SETTLED)
            await anyio.sleep(0.05)
        for name, type_name in sorted(seen.items()):
            if as_json:
                say_json({"topic": name, "type": type_name})
            else:
                say(f"{name}  {type_name}")

    run_at(url, act)


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
        with await _subscribed(node, topic, qos, timeout) as messages:
            if once:
                show(await messages.next(timeout), full=full, as_json=as_json)
            else:
                await until_interrupted(partial(_echo, messages, full=full, as_json=as_json))

    run_at(url, act)


async def _echo(messages: Any, *, full: bool, as_json: bool) -> None:
    while True:
        show(await messages.next(), full=full, as_json=as_json)


async def _subscribed(node: Any, topic: str, qos: str, timeout: float) -> Any:
    type_name = await node.type_of(topic, timeout=timeout)
    return node.subscribe(topic, type_name, qos=qos, depth=100)


@topic_command.command("hz")
@click.argument("topic")
@qos_option
@timeout_option
@json_option
@url_option
def measure_topic(topic: str, qos: str, timeout: float, as_json: bool, url: str) -> None:
    """Measure how often messages of TOPIC arrive, each second until Ctrl-C."""

    async def act(node: Any) -> None:
        with await _subscribed(node, topic, qos, timeout) as messages:
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
        gaps = [later - before for before, later in zip(times, [*times][1:], strict=False)]
        if as_json:
            say_json({"rate": rate, "min": min(gaps), "max": max(gaps), "window": len(times)})
        else:
            say(
                f"average rate: {rate:.3f}\n"
                f"\tmin: {min(gaps):.3f}s max: {max(gaps):.3f}s window: {len(times)}"
            )


@topic_command.command("pub")
@click.argument("topic")
@click.argument("type_name", metavar="TYPE")
@click.argument("message", default="")
@click.option("--once", is_flag=True, help="Publish one message when someone reads it, and exit.")
@click.option("--rate", type=click.FloatRange(0.001), default=1.0, help="Messages a second.")
@qos_option
@timeout_option
@url_option
def publish(
    topic: str,
    type_name: str,
    message: str,
    once: bool,
    rate: float,
    qos: str,
    timeout: float,
    url: str,
) -> None:
    """Publish MESSAGE, which is YAML, on TOPIC until Ctrl-C."""
    value = read_goal(message or "{}", {})

    async def act(node: Any) -> None:
        with node.publisher(topic, type_name, qos=qos) as publisher:
            if once:
                await publisher.wait_for_reader(timeout)
                await publisher.publish(value)
                await anyio.sleep(SETTLED)  # the message leaves, and what is lost is sent again
                return

            async def repeat() -> None:
                while True:
                    await publisher.publish(value)
                    await anyio.sleep(1 / rate)

            await until_interrupted(repeat)

    run_at(url, act)


@click.group(
    "service",
    epilog='\b\nExample:\n  fibaction service call /lamp std_srvs/srv/SetBool "data: true" -u dds://',
)
def service_command() -> None:
    """Call services of ROS, at ros2://, dds:// and zenoh:// URLs."""


@service_command.command("call")
@click.argument("service")
@click.argument("type_name", metavar="TYPE")
@click.argument("request", default="")
@timeout_option
@full_option
@json_option
@url_option
def call_service(
    service: str,
    type_name: str,
    request: str,
    timeout: float,
    full: bool,
    as_json: bool,
    url: str,
) -> None:
    """Send REQUEST, which is YAML, to SERVICE once, and print the answer."""
    value = read_goal(request or "{}", {})

    async def act(node: Any) -> None:
        answer = plain(await node.call(service, type_name, value, timeout=timeout))
        if as_json:
            say_json(answer)
        else:
            say(as_yaml(answer, full=full))

    run_at(url, act)


@click.group(
    "param",
    epilog="\b\nExamples:\n  fibaction param list /planner -u dds://\n"
    "  fibaction param set /planner tolerance 0.2 -u dds://",
)
def param_command() -> None:
    """List, read and set parameters of nodes, at ros2://, dds:// and zenoh:// URLs."""


@param_command.command("list")
@click.argument("node_name", metavar="NODE")
@timeout_option
@url_option
def list_parameters(node_name: str, timeout: float, url: str) -> None:
    """List the parameters of NODE with their values."""

    async def act(node: Any) -> None:
        for name, value in (await node.parameters(node_name, timeout=timeout).get()).items():
            say(f"{name}: {as_yaml(value, full=True).strip()}")

    run_at(url, act)


@param_command.command("get")
@click.argument("node_name", metavar="NODE")
@click.argument("name")
@timeout_option
@json_option
@url_option
def get_parameter(node_name: str, name: str, timeout: float, as_json: bool, url: str) -> None:
    """Print the parameter NAME of NODE."""

    async def act(node: Any) -> None:
        value = (await node.parameters(node_name, timeout=timeout).get(name))[name]
        if value is None:
            raise Failure(f"{node_name} has no parameter {name!r}")
        if as_json:
            say_json(value)
        else:
            say(as_yaml(value, full=True).strip())

    run_at(url, act)


@param_command.command("set")
@click.argument("node_name", metavar="NODE")
@click.argument("name")
@click.argument("value")
@timeout_option
@url_option
def set_parameter(node_name: str, name: str, value: str, timeout: float, url: str) -> None:
    """Set the parameter NAME of NODE to VALUE, which is YAML."""
    read = read_goal(value, {})

    async def act(node: Any) -> None:
        try:
            await node.parameters(node_name, timeout=timeout).set({name: read})
        except TypeError as exc:
            raise Failure(str(exc)) from exc

    run_at(url, act)
