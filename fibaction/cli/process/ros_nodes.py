"""The node of ROS in which a verb runs, and the form of what it prints."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, Final, TypeVar

import click

from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.output.escape import printable
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run

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
