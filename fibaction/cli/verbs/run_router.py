"""`fibaction router`: a router of Zenoh, which the library of Zenoh can be."""

from __future__ import annotations

import json
from importlib import import_module
from typing import Any

import click
from anyio import to_thread

from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, run
from fibaction.cli.process.signals import stop_signals

HOST, PORT = "localhost", 7447


@click.command(
    "router",
    epilog="""\b
Examples:
  fibaction router
  fibaction serve robot:server zenoh://
  fibaction list -u zenoh://""",
)
@click.option(
    "--host",
    default=HOST,
    show_default=True,
    help="The address to listen at; 0.0.0.0 lets every machine of the network in.",
)
@click.option(
    "--port", type=click.IntRange(1, 65535), default=PORT, show_default=True, help="The port."
)
def router_command(host: str, port: int) -> None:
    """Run a router of Zenoh, which nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp need.

    Use it for tests and a first try without ROS. Everyone who can reach it can serve and
    call every action.

    Ctrl-C or SIGTERM stops it. Peers that know each other continue without it.
    """
    check_installed("zenoh", "fibaction router", "zenoh")
    bare = host.strip("[]")
    run(run_router, f"tcp/[{bare}]:{port}" if ":" in bare else f"tcp/{bare}:{port}")


async def run_router(locator: str) -> int:
    """Run a router until a signal comes.

    Raises:
        Failure: It cannot listen there.
    """
    zenoh: Any = import_module("zenoh")  # its stub leaves out what returns nothing

    config = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [locator],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    async with stop_signals() as stop:
        try:
            session = await to_thread.run_sync(zenoh.open, config)
        except zenoh.ZError as exc:
            raise Failure(f"the router cannot listen at {_why(locator, str(exc))}") from exc
        try:
            say(f"router at {locator}, Ctrl-C stops it")
            await stop.wait()
        finally:
            await to_thread.run_sync(session.close)
    return ExitCode.SUCCEEDED


def _why(locator: str, text: str) -> str:
    """Return a locator with the reason, without the places in the source of Zenoh."""
    if "in use" in text:
        return f"{locator}, which is in use: another router may be running there, or give --port"
    return f"{locator}: {excerpt(text.partition(' at /')[0])}"
