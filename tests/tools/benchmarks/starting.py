"""The cost of starting a program, as processor time, which a busy machine hardly changes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from tests.tools.benchmarks.program import ROOT
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


def _of(code: str) -> tuple[str | Path, ...]:
    return (sys.executable, "-c", code)


def _of_ros(code: str) -> tuple[str | Path, ...]:
    return (ROS_PYTHON, "-c", code)


STARTS = {
    "nothing": Start("python -c pass", IN_FIBACTION, _of("pass")),
    "asyncio": Start("import asyncio", IN_FIBACTION, _of("import asyncio")),
    "needed": Start("import anyio, msgspec", IN_FIBACTION, _of("import anyio, msgspec")),
    "fibaction": Start("import fibaction", IN_FIBACTION, _of("import fibaction"), True),
    "client": Start(
        "all that a client needs",
        IN_FIBACTION,
        _of("from fibaction import Action, connect"),
        True,
    ),
    "server": Start(
        "all that a server needs",
        IN_FIBACTION,
        _of("from fibaction import Action, ActionServer, GoalHandle, serve"),
        True,
    ),
    "help": Start(
        "fibaction --help",
        IN_FIBACTION,
        (Path(sys.executable).with_name("fibaction"), "--help"),
        True,
    ),
    "grpc": Start("import grpc.aio", IN_FIBACTION, _of("import grpc.aio"), needs="grpc"),
    "nats": Start("import nats", IN_FIBACTION, _of("import nats"), needs="nats"),
    "ros_nothing": Start("python -c pass", IN_ROS, _of_ros("pass"), needs="rclpy"),
    "ros_fibaction": Start(
        "import of the ros2 transport",
        IN_ROS,
        _of_ros("import fibaction_transports.ros2"),
        True,
        needs="ros2",
    ),
    "rclpy": Start("import rclpy.action", IN_ROS, _of_ros("import rclpy.action"), needs="rclpy"),
}


def processor_seconds(command: tuple[str | Path, ...]) -> float:
    """Return the processor seconds of a command, in all of its threads.

    Raises:
        RuntimeError: It failed.
    """
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))} failed")
    return usage.ru_utime + usage.ru_stime


def start(without: Mapping[str, str], scale: float) -> dict[str, Any]:
    """Measure milliseconds of processor time, without a first round from a cold disk."""
    taken: dict[str, list[float]] = {
        key: [] for key, start in STARTS.items() if start.needs not in without
    }
    for number in range(max(3, round(ROUNDS * scale)) + 1):
        for key, seconds in taken.items():
            used = processor_seconds(STARTS[key].command)
            if number:
                seconds.append(used)
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
