"""A program that runs where the wheel is installed with one extra, and uses what the extra is for.

    python -P extras.py EXTRA VERSION

It is run as a file in an environment that has no tests, so it uses only fibaction and the extra.
`none` is the wheel without an extra, and `all` is all of them together. `make release` makes the
environments.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import anyio

import fibaction
from fibaction import Action, ActionServer, GoalHandle, Report, action, call, serve
from fibaction.action_files import load_action

GO_TO = """\
geometry_msgs/Pose pose
---
---
"""
PATIENCE = 60.0


@action("drive")
async def drive(meters: int, report: Report[int]) -> str:
    """Drive, as in the first program of README."""
    for done in range(1, meters + 1):
        await report(done)
    return f"drove {meters} m"


async def _drives(server: ActionServer[int, int, str], url: str) -> None:
    async with serve(server, url) as (address,):
        seen: list[int] = []
        assert await call(address, drive, 3, on_feedback=seen.append) == "drove 3 m"
        assert seen == [1, 2, 3]


def _none() -> None:
    for url in ("inproc://robot", "tcp://127.0.0.1:0"):
        anyio.run(_drives, ActionServer(drive), url)


def _opens(url: str) -> None:
    """Serve at a URL with a token."""

    async def open_it() -> None:
        async with serve(drive, f"{url}?token=secret") as (address,):
            assert address.startswith("http://")

    anyio.run(open_it)


def _watched(name: str) -> None:
    """Drive beside a watcher of `fibaction.observe`."""
    watcher = getattr(import_module("fibaction.observe"), name)()
    anyio.run(_drives, ActionServer(drive, watchers=[watcher]), "inproc://robot")


def _program(name: str, *arguments: str) -> str:
    """Return what a program of this environment prints."""
    command = [str(Path(sys.executable).parent / name), *arguments]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=PATIENCE)
    return done.stdout


def _broker() -> None:
    assert _program("nats-server", "--version").startswith("nats-server: v2.")


def _cli() -> None:
    assert _program("fibaction", "--version") == f"fibaction {fibaction.__version__}\n"


def _mcap() -> None:
    from fibaction.observe import Recorder, export_mcap

    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "drives.jsonl"
        with Recorder(recording) as recorder:
            anyio.run(_drives, ActionServer(drive, watchers=[recorder]), "inproc://robot")
        assert export_mcap(recording, Path(folder) / "drives.mcap") > 0


def _nats() -> None:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    assert len(Ed25519PrivateKey.generate().sign(b"nonce")) == 64


def _progress() -> None:
    from tqdm import tqdm

    assert list(tqdm([1, 2], disable=True)) == [1, 2]


def _pydantic() -> None:
    from pydantic import BaseModel

    class Distance(BaseModel):
        meters: int

    async def far(goal: GoalHandle[Distance]) -> AsyncIterator[int | str]:
        yield goal.request.meters
        yield f"drove {goal.request.meters} m"

    far_drive = Action("drive_far", goal=Distance, feedback=int, result=str)

    async def drives() -> None:
        async with serve(ActionServer(far_drive, far), "inproc://robot"):
            assert await call("inproc://robot", far_drive, Distance(meters=3)) == "drove 3 m"

    anyio.run(drives)


def _ros_types() -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot_msgs" / "action" / "GoTo.action"
        file.parent.mkdir(parents=True)
        file.write_text(GO_TO, encoding="utf-8")
        goal = load_action(file).goal.type()
        assert goal.pose.orientation.w == 1


def _has(library: str) -> None:
    assert find_spec(library) is not None


def _tui() -> None:
    assert "Usage:" in _program("fibaction", "top", "--help")
    _has("textual")


def _uvloop() -> None:
    url = "tcp://127.0.0.1:0"
    anyio.run(_drives, ActionServer(drive), url, backend_options={"use_uvloop": True})


def _web() -> None:
    async def drives() -> None:
        async with serve(drive, "http://127.0.0.1:0") as (address,):
            there = address.replace("http", "ws", 1)
            assert await call(there, drive, 3, on_feedback=lambda _: None) == "drove 3 m"

    anyio.run(drives)


def _zenoh() -> None:
    from fibaction_transports.ros2 import ZenohTransport

    assert ZenohTransport.from_url("zenoh://robot.local:7447/arm").url.startswith("zenoh://")


CHECKS: dict[str, Callable[[], None]] = {
    "a2a": lambda: _opens("a2a+http://127.0.0.1:0"),
    "broker": _broker,
    "cli": _cli,
    "mcap": _mcap,
    "mcp": lambda: _opens("mcp+http://127.0.0.1:0"),
    "metrics": lambda: _watched("Metrics"),
    "nats": _nats,
    "otel": lambda: _watched("Tracing"),
    "progress": _progress,
    "pydantic": _pydantic,
    "reload": lambda: _has("watchfiles"),
    "ros-types": _ros_types,
    "tui": _tui,
    "uvloop": _uvloop,
    "web": _web,
    "zenoh": _zenoh,
}
"""What each extra is for, tried once."""


def main() -> None:
    """Try one extra."""
    parser = argparse.ArgumentParser(prog="python -P extras.py", description="Try one extra.")
    parser.add_argument("extra", choices=["none", "all", *CHECKS])
    parser.add_argument("version", help="the version that has to be installed")
    chosen = parser.parse_args()
    assert fibaction.__version__ == chosen.version, fibaction.__version__
    _none()
    for name, check in CHECKS.items():
        if chosen.extra in (name, "all"):
            check()
    print(f"{chosen.extra}: works with {chosen.version}")


if __name__ == "__main__":
    main()
