"""The environment of the tests with ROS 2: their domain, and skips that are failures."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fibaction_transports.ros2.on_rclpy.rcl import middleware

CONFTEST = Path(__file__).with_name("conftest.py")
SKIPPING = """
import pytest

def test_passes():
    pass

def test_skips():
    pytest.skip("no robot")

@pytest.mark.xfail(reason="known")
def test_fails_as_expected():
    assert False
"""

LEAVING = """
import rclpy
from rclpy.action import ActionServer
from test_msgs.action import Fibonacci

left = []

def test_leaves_a_server():
    rclpy.init()
    node = rclpy.create_node("left")
    left.append(ActionServer(node, Fibonacci, "left", print))
    node.destroy_node()
    rclpy.shutdown()
"""


def run(folder: Path, *, required: bool, conftest: str | None = None) -> tuple[int, str]:
    """Run the tests of a folder with this conftest, and return the exit code and the output."""
    (folder / "conftest.py").write_text(conftest or CONFTEST.read_text())
    (folder / "pytest.ini").touch()  # ours has paths that are not there
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rs", str(folder)],
        cwd=folder,
        env={**os.environ, "FIBACTION_ROS": "required" if required else ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=50,
    )
    return ended.returncode, ended.stdout


def test_a_skip_is_a_failure_where_ros_is_required(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(SKIPPING)

    code, said = run(tmp_path, required=True)

    assert code == 1
    assert "1 failed, 1 passed, 1 xfailed" in said
    assert "a skip is a failure" in said
    assert "no robot" in said


@pytest.mark.skipif("fastrtps" not in middleware(), reason="the threads are those of Fast DDS")
def test_a_node_that_a_test_leaves_in_the_graph_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(LEAVING)

    code, said = run(tmp_path, required=True)

    assert code == 1
    assert "1 passed" in said
    assert "1 error" in said
    assert "assert 1 <= 0" in said
