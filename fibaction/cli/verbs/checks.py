"""`fibaction wait`, `ping` and `doctor`: check the connection to a server."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from time import perf_counter
from typing import TypeAlias
from urllib.parse import urlsplit

import anyio
import click

from fibaction._api import ClientConnection, connect
from fibaction.border.abc import Diagnosis
from fibaction.border.urls import transport_for, without_settings
from fibaction.cli.arguments.completion import ACTION
from fibaction.cli.arguments.names import shown
from fibaction.cli.arguments.options import (
    NumberType,
    json_option,
    reject_inproc,
    url_of,
    url_option,
)
from fibaction.cli.output.escape import clean
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, Failure, run
from fibaction.cli.verbs.actions import with_type
from fibaction.types.action import ActionInfo
from fibaction.wire.messages import VERSION
from fibaction.words.errors import ConnectionLost, ServerNotFound
from fibaction.words.goals import ActionPeers

LOOK_PAUSE = 0.2
"""Seconds between two looks for the actions."""


@click.command(
    "wait",
    epilog="""\b
Examples:
  fibaction wait fibonacci && fibaction send_goal fibonacci "order: 10"
  fibaction wait arm/pick arm/place -t 30""",
)
@click.argument("names", metavar="NAME...", nargs=-1, required=True, type=ACTION)
@click.option(
    "-t",
    "--timeout",
    type=NumberType(),
    metavar="SECONDS",
    help="Give up after that time, with exit code 6.",
)
@url_option
def wait_command(names: tuple[str, ...], timeout: float | None, url: str) -> None:
    """Wait until the actions are served, and print nothing."""
    run(wait, url, names, timeout)


async def wait(url: str, names: Sequence[str], timeout: float | None) -> int:
    """Wait until all actions are served.

    Raises:
        Failure: They are not within `timeout` seconds.
        ActionError: The server cannot be asked, for another reason than that it does not run.
    """
    missing = {shown(name) for name in names}
    with anyio.move_on_after(math.inf if timeout is None else timeout):
        async with connect(url) as connection:
            while True:
                missing -= await _served(connection)
                if not missing:
                    return ExitCode.SUCCEEDED
                await anyio.sleep(LOOK_PAUSE)
    raise Failure(
        f"{', '.join(sorted(missing))}: not served within {timeout:g} s", ExitCode.UNREACHABLE
    )


async def _served(connection: ClientConnection) -> set[str]:
    try:
        return {shown(info.name) for info in await connection.actions()}
    except (ServerNotFound, ConnectionLost):
        return set()


TIMES = 5
"""Round trips that are measured; the shortest is told."""

OTHER_PROTOCOLS = {"ros2", "rosbridge", "rosbridges"}
"""Schemes of URLs at which the protocol is not that of fibaction."""


@click.command(
    "ping",
    epilog="""\b
Examples:
  fibaction ping
  fibaction ping tcp://robot:7400 --json""",
)
@click.argument("where", metavar="[URL]", required=False)
@json_option
@url_option
def ping_command(where: str | None, as_json: bool, url: str) -> None:
    """Ask the server at URL for an answer: print the time that it took, the version of the
    protocol, and the actions that it offers, each with its servers and clients.
    """
    if where is not None:
        reject_inproc(where)
    run(ping, where or url, as_json=as_json)


async def ping(url: str, *, as_json: bool) -> int:
    """Print what a server answers.

    Raises:
        ActionError: It does not.
    """
    start = perf_counter()
    async with connect(url) as connection:
        actions = await connection.actions()
        first = perf_counter() - start
        times: list[float] = []
        for _ in range(TIMES):
            start = perf_counter()
            actions = await connection.actions()
            times.append(perf_counter() - start)
        found = sorted(actions, key=lambda info: shown(info.name))
        peers = [await _peers(connection, info) for info in found]
    protocol = None if urlsplit(url).scheme in OTHER_PROTOCOLS else VERSION
    if as_json:
        say_json(
            {
                "url": without_settings(url),
                "first_answer": first,
                "round_trip": min(times),
                "version": version("fibaction"),
                "protocol": protocol,
                "actions": [
                    {
                        "name": info.name,
                        "type": info.type_name,
                        "servers": one.servers,
                        "clients": one.clients,
                    }
                    for info, one in zip(found, peers, strict=True)
                ],
            }
        )
        return ExitCode.SUCCEEDED
    say(f"{without_settings(url)} answers: {_ms(min(times))}, the first time {_ms(first)}")
    both = "" if protocol is None else f", version {protocol} of the protocol at both ends"
    say(f"fibaction {version('fibaction')} here{both}")
    say(f"Actions: {len(found)}")
    for info, one in zip(found, peers, strict=True):
        counts = f"{_count(one.servers, 'server')}, {_count(one.clients, 'client')}"
        say(f"    {with_type(shown(info.name), info.type_name)}: {counts}")
    return ExitCode.SUCCEEDED


async def _peers(connection: ClientConnection, info: ActionInfo) -> ActionPeers:
    try:
        return await connection.peers(info.name)
    except ServerNotFound:  # it has stopped in the meantime
        return ActionPeers()


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.1f} ms"


def _count(names: tuple[str, ...], what: str) -> str:
    return f"{len(names)} {what}{'' if len(names) == 1 else 's'}"


WHERE = "dds://"
"""The default URL of `doctor`: that of the transport whose servers are discovered."""
Fact: TypeAlias = "dict[str, Fact] | list[Fact] | str | int | float | bool"
"""A fact of a diagnosis: a value of JSON."""
_INDENT = "    "


@click.command(
    "doctor",
    epilog="""\b
Examples:
  fibaction doctor
  fibaction doctor "dds://?peers=robot.local" --action navigate_to_pose""",
)
@click.argument("where", metavar="[URL]", required=False)
@click.option(
    "-s",
    "--seconds",
    type=NumberType(),
    default=3.0,
    show_default=True,
    help="Time for which it listens.",
)
@click.option("-a", "--action", metavar="NAME", default="", help="Action that is to be found.")
@json_option
@click.pass_context
def doctor_command(
    context: click.Context, where: str | None, seconds: float, action: str, as_json: bool
) -> None:
    """Report what is found at URL, and what to do if it is not what you expect. The default is
    dds://, unless you give a URL in another way.

    At dds://, it listens for other participants; at other URLs, it tries to connect.
    """
    url = where or _given(context) or WHERE
    reject_inproc(url)
    run(diagnose, url, seconds, action, as_json=as_json)


async def diagnose(url: str, seconds: float, action: str, *, as_json: bool) -> int:
    """Print the diagnosis of a transport.

    Raises:
        ActionError: The server cannot be asked.
    """
    found = await transport_for(url).diagnose(seconds, action)
    if as_json:
        told = {"found": found.is_found, **found.facts, "advice": found.advice}
        say_json({"url": without_settings(url), **told})
    else:
        for line in lines(found):
            say(clean(line))
    return ExitCode.SUCCEEDED if found.is_found else ExitCode.UNREACHABLE


def lines(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield the lines of a diagnosis: the facts, and then the advice."""
    facts: dict[str, Fact] = diagnosis.facts
    for name, value in facts.items():
        if not isinstance(value, list):
            yield f"{_words(name)}: {_text(value)}"
            continue
        yield f"{_words(name)}: {len(value) or 'none'}"
        for one in value:
            yield f"{_INDENT}{_text(one)}"
    for sentence in diagnosis.advice:
        yield f"Advice: {sentence}"


def _text(value: Fact) -> str:
    if isinstance(value, dict):
        parts = (f"{_words(name, first=False)} {_text(one)}" for name, one in value.items())
        return ", ".join(parts)
    if isinstance(value, list):
        return " ".join(map(_text, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def _words(name: str, *, first: bool = True) -> str:
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:] if first else words


def _given(context: click.Context) -> str:
    """Return the URL that the user has given elsewhere than to `doctor`; empty if none."""
    root = context.find_root()
    source = root.get_parameter_source("url")
    is_given = source is not click.core.ParameterSource.DEFAULT or root.params["address"]
    return url_of(context) if is_given else ""
