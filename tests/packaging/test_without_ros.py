"""The program with which `docs/howto/ros2_without_ros.md` begins, with the wheel and no ROS, at a
stock server of rclpy in another process.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.pages import blocks_of
from tests.support.processes import PATIENCE
from tests.support.ros_domain import own_domain

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/howto/ros2_without_ros.md"
ROS_PYTHON = ROOT / ".venv-ros/bin/python"
FILES = ROOT / "examples/ros2"
PYTHONS = sorted(ROOT.glob("build/consumer*/bin/python"))
"""Environments with the wheel and what it requires, one for each Python that is here."""
NO_ROS = """
import importlib.util, sys
assert not [name for name in sys.modules if name.startswith("rcl")]
assert importlib.util.find_spec("rclpy") is None
"""

needs_ros = pytest.mark.skipif(
    not ROS_PYTHON.exists() and os.environ.get("FIBACTION_ROS") != "required",
    reason="make ros has not been run",
)


def program() -> str:
    """Return the program of the page, with the action of the stock server instead of Nav2's."""
    page = next(block.code for block in blocks_of(PAGE.read_text()) if block.language == "python")
    there = '"arduinobot_msgs/action/Fibonacci.action", name="stock"'
    page, loads = re.subn(r'"nav2_msgs/action/NavigateToPose.action"', there, page)
    page, goals = re.subn(r"(?:        goal\.pose\..*\n)+", "        goal.order = 5\n", page)
    page, fields = re.subn(r"seen\.distance_remaining", "seen.partial_sequence[-1]", page)
    assert (loads, goals, fields) == (1, 1, 1)
    return page + NO_ROS


@pytest.fixture(scope="module")
def stock_server() -> Iterator[None]:
    with own_domain():
        process = subprocess.Popen(
            [ROS_PYTHON, "-m", "tests.ros2.stock.server"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), f"{ROOT}/transports"])},
        )
        with process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline()
                yield
            finally:
                process.kill()


@needs_ros
@pytest.mark.usefixtures("stock_server")
@pytest.mark.parametrize("python", PYTHONS, ids=lambda path: path.parts[-3])
def test_the_first_program_of_the_page_drives_a_stock_server(python: Path) -> None:
    done = subprocess.run(
        [python, "-W", "error", "-c", program()],
        cwd=FILES,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
    )
    assert (done.stdout, done.stderr) == ("1\n2\n3\n5\n", "")
