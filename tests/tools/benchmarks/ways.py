"""The ways to run goals that are compared, their availability and their start."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import asynccontextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from tests.support.json_program import ROOT, Program, program
from tests.support.nats_server import PROGRAM

IN_ONE, BETWEEN, ROS = (
    "In one process",
    "Between two processes",
    "Between two processes, over ROS 2",
)
ROS_PYTHON = Path(os.environ.get("FIBACTION_ROS_PYTHON", ROOT / ".venv-ros" / "bin" / "python"))
"""The Python of an environment with ROS 2, as `make ros` makes it."""
LOOK_TIMEOUT = 60.0


class Way(NamedTuple):
    label: str
    group: str
    module: str
    """The name of its module, without `over_`, and of its `Ends` there, if it has several."""
    is_ours: bool = True
    has_server: bool = True
    """True if the server has a process of its own."""
    loop: str = "asyncio"
    """The event loop of both ends."""


WAYS = {
    "inproc": Way("fibaction, inproc", IN_ONE, "fibaction.inproc", has_server=False),
    "tasks": Way("anyio tasks and streams", IN_ONE, "tasks", is_ours=False, has_server=False),
    "tcp": Way("fibaction, tcp", BETWEEN, "fibaction"),
    "tcp_uvloop": Way("fibaction, tcp, uvloop", BETWEEN, "fibaction", loop="uvloop"),
    "tcp_trio": Way("fibaction, tcp, trio", BETWEEN, "fibaction", loop="trio"),
    "tls": Way("fibaction, tls", BETWEEN, "fibaction.tls"),
    "unix": Way("fibaction, unix", BETWEEN, "fibaction.unix"),
    "ws": Way("fibaction, ws", BETWEEN, "fibaction.ws"),
    "http": Way("fibaction, http: REST", BETWEEN, "http"),
    "grpc": Way("grpc.aio", BETWEEN, "grpc", is_ours=False),
    "nats": Way("NATS", BETWEEN, "nats", is_ours=False),
    "sockets": Way("bare anyio sockets", BETWEEN, "sockets", is_ours=False),
    "task_sockets": Way("bare sockets, a task a goal", BETWEEN, "sockets.tasks", is_ours=False),
    "ros2": Way("fibaction, ros2", ROS, "fibaction.ros2"),
    "rclpy": Way("rclpy", ROS, "rclpy", is_ours=False),
    "rclpy_deep": Way("rclpy, queues of 3,000", ROS, "rclpy.deep", is_ours=False),
    "rclpy_events": Way("rclpy, EventsExecutor", ROS, "rclpy.events", is_ours=False),
}

KEPT = {
    "inproc": Way("fibaction, inproc", IN_ONE, "fibaction.inproc_kept", has_server=False),
    "tcp": Way("fibaction, tcp", BETWEEN, "fibaction.kept"),
}
"""The ways with servers that keep every result."""


class Pair(NamedTuple):
    """The two ends of a way."""

    server: Program | None
    client: Program


def left_out(ros_python: Path = ROS_PYTHON) -> dict[str, str]:
    """Return the unavailable ways, each with the reason as a sentence."""
    reasons = left_out_here(lambda name: find_spec(name) is not None, PROGRAM)
    if why := no_ros(ros_python):
        reasons |= {key: why for key, way in WAYS.items() if way.group == ROS}
    return reasons


def left_out_here(is_installed: Callable[[str], bool], server: str | None) -> dict[str, str]:
    """Return the ways that lack a library of this environment, or the program of a server."""
    reasons: dict[str, str] = {}
    if not is_installed("grpc"):
        reasons["grpc"] = "grpcio is not installed; `make bench` installs it"
    if not is_installed("nats"):
        reasons["nats"] = "nats-py is not installed; `make bench` installs it"
    elif server is None:
        reasons["nats"] = "there is no nats-server; Debian and Ubuntu have it in a package"
    return reasons


def no_ros(python: Path) -> str:
    """Return the reason why ROS 2 cannot be used with a Python; empty if it can."""
    if not python.exists():
        return "there is no .venv-ros; `make ros` makes it, on Linux on x86_64"
    looked = subprocess.run(
        [python, "-c", "import rclpy, arduinobot_msgs.action"],
        capture_output=True,
        text=True,
        timeout=LOOK_TIMEOUT,
        check=False,
    )
    if looked.returncode:
        last = (looked.stderr.strip().splitlines() or ["nothing more is known"])[-1]
        return f".venv-ros cannot be used ({last}); `make ros` mends it"
    return ""


def versions(without: Mapping[str, str]) -> dict[str, str]:
    """Return the versions of the libraries that the ways use."""
    found = {name: version(name) for name in ("fibaction", "anyio", "msgspec")}
    if "grpc" not in without:
        found["grpcio"] = version("grpcio")
    if "nats" not in without:
        assert PROGRAM is not None
        told = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, check=True)
        found["nats-py"] = version("nats-py")
        found["nats-server"] = told.stdout.split()[-1].removeprefix("v")
    if "rclpy" not in without:
        code = "from importlib.metadata import version; print(version('ros-rclpy'))"
        told = subprocess.run([ROS_PYTHON, "-c", code], capture_output=True, text=True, check=True)
        found["rclpy"] = told.stdout.strip()
    return found


@asynccontextmanager
async def started(
    way: Way, environment: Mapping[str, str] | None = None
) -> AsyncGenerator[Pair, None]:
    """Run both ends of a way until the block ends.

    Raises:
        RuntimeError: One of them did not start.
    """
    python = ROS_PYTHON if way.group == ROS else Path(sys.executable)
    child = ("-m", "tests.tools.benchmarks.child", "--loop", way.loop)
    if not way.has_server:
        async with program(python, *child, "client", way.module, "") as client:
            await client.line()
            yield Pair(None, client)
        return
    async with program(python, *child, "server", way.module, environment=environment) as server:
        address = await server.line()
        arguments = (*child, "client", way.module, address)
        async with program(python, *arguments, environment=environment) as client:
            await client.line()
            yield Pair(server, client)


@asynccontextmanager
async def ros_environment() -> AsyncGenerator[dict[str, str], None]:
    """Set a ROS domain for this run, on this machine only, without log files in the home folder."""
    from tests.support.ros_domain import claim_domain

    domain, claim = claim_domain(os.getpid())
    with claim, TemporaryDirectory() as folder:
        yield {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": folder,
        }
