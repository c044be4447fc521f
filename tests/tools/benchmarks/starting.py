"""The cost of starting a program, as processor time, which a busy machine hardly changes."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from tests.support.processes import used_by
from tests.tools.benchmarks.ways import ROS_PYTHON

ROUNDS = 11
IN_FIBACTION, IN_ROS = "The environment of fibaction", "The environment of ROS 2"


class Start(NamedTuple):
    label: str
    group: str
    command: tuple[str | Path, ...]
    is_ours: bool = False
    needs: str = ""
    """The way that must be available for it."""


def _here(label: str, code: str, *, ours: bool = False, needs: str = "") -> Start:
    return Start(label, IN_FIBACTION, (sys.executable, "-c", code), ours, needs)


def _ros(label: str, code: str, *, ours: bool = False, needs: str = "rclpy") -> Start:
    return Start(label, IN_ROS, (ROS_PYTHON, "-c", code), ours, needs)


HELP = (Path(sys.executable).with_name("fibaction"), "--help")
SERVER = "from fibaction import Action, ActionServer, GoalHandle, serve"
OVER_ROS = "import fibaction_transports.ros2"
STARTS = {
    "nothing": _here("python -c pass", "pass"),
    "asyncio": _here("import asyncio", "import asyncio"),
    "needed": _here("import anyio, msgspec", "import anyio, msgspec"),
    "fibaction": _here("import fibaction", "import fibaction", ours=True),
    "client": _here("all that a client needs", "from fibaction import Action, connect", ours=True),
    "server": _here("all that a server needs", SERVER, ours=True),
    "help": Start("fibaction --help", IN_FIBACTION, HELP, True),
    "grpc": _here("import grpc.aio", "import grpc.aio", needs="grpc"),
    "nats": _here("import nats", "import nats", needs="nats"),
    "ros_nothing": _ros("python -c pass", "pass"),
    "ros_fibaction": _ros("import of the ros2 transport", OVER_ROS, ours=True, needs="ros2"),
    "rclpy": _ros("import rclpy.action", "import rclpy.action"),
}


def start(without: Mapping[str, str], scale: float) -> dict[str, Any]:
    """Measure milliseconds of processor time, without a first round from a cold disk."""
    taken: dict[str, list[float]] = {
        key: [] for key, start in STARTS.items() if start.needs not in without
    }
    for number in range(max(3, round(ROUNDS * scale)) + 1):
        for key, seconds in taken.items():
            used = used_by(STARTS[key].command)
            if number:
                seconds.append(used.seconds)
    ways = {
        key: {
            "label": STARTS[key].label,
            "group": STARTS[key].group,
            "ours": STARTS[key].is_ours,
            "milliseconds": round(median(seconds) * 1e3),
            "low": round(min(seconds) * 1e3),
            "high": round(max(seconds) * 1e3),
        }
        for key, seconds in taken.items()
    }
    return {"ways": ways, "ratios": []}
