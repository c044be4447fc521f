"""`fibaction ping`: the round trip to a server, what it offers, and who uses it."""

from __future__ import annotations

from importlib.metadata import version
from time import perf_counter
from urllib.parse import urlsplit

import click

from fibaction._api import ClientConnection, connect
from fibaction.border.urls import without_settings
from fibaction.cli.arguments.action_names import shown
from fibaction.cli.arguments.options import json_option, reject_inproc, url_option
from fibaction.cli.output.lines import say, say_json
from fibaction.cli.process.exit_codes import ExitCode, run
from fibaction.cli.verbs.list import with_type
from fibaction.types.action import ActionInfo
from fibaction.wire.messages import VERSION
from fibaction.words.errors import ServerNotFound
from fibaction.words.goals import ActionPeers

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
