"""The command line over `ros2://`: the same verbs, as processes, and a real server of ROS 2."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import uuid
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from std_msgs.msg import String
from test_msgs.srv import BasicTypes

from tests.ros2.spun import spun_node

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("fibaction")
URL = "ros2://?discovery_timeout=20"
PATIENCE = 60.0
"""Seconds for a whole command: many times more than usual, as discovery may be late."""


@pytest.fixture(scope="module", autouse=True)
def server() -> Generator[None, None, None]:
    """The Fibonacci example, as an action of ROS 2."""
    process = subprocess.Popen(
        [sys.executable, "examples/fibonacci_server.py", "--url", "ros2://", "--period", "1.5"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("serving fibonacci")
            fibaction("send_goal", "fibonacci", "order: 1", code=0)  # it has been found
            yield
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()


def fibaction(*arguments: str, code: int) -> list[str]:
    """Run the command, check its exit code, and return the lines that it prints."""
    done = subprocess.run(
        [COMMAND, "-u", URL, *arguments], capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout.splitlines()


@pytest.fixture(params=["ros2://", "dds://"])
def at(request: pytest.FixtureRequest) -> tuple[str, str]:
    """The option of a way to a stock node."""
    return "-u", request.param


@pytest.mark.timeout(4 * PATIENCE)  # nine commands, each of which imports ROS
def test_topics_services_and_parameters_of_a_stock_node_are_read_and_set(
    at: tuple[str, str],
) -> None:
    def answer(request: Any, response: Any) -> Any:
        response.string_value = request.string_value.upper()
        return response

    def heard(message: Any) -> None:
        texts.append(message.data)

    texts: list[str] = []
    space = f"/t{uuid.uuid4().hex}"
    with spun_node(space, "stock") as stock:
        talk = stock.create_publisher(String, "chatter", 10)
        stock.create_timer(0.1, lambda: talk.publish(String(data="hello")))
        stock.create_subscription(String, "heard", heard, 10)
        stock.create_service(BasicTypes, "shout", answer)
        stock.declare_parameter("speed", 0.5)
        assert f"{space}/chatter" in fibaction("topic", "list", *at, code=0)
        once = fibaction("topic", "echo", f"{space}/chatter", "--once", *at, code=0)
        assert once == ["data: hello", "---"]
        info = fibaction("topic", "info", f"{space}/chatter", "-v", *at, code=0)
        assert {"Node name: stock", f"Node namespace: {space}", "  Deadline: Infinite"} <= {*info}
        to_it = f"{space}/heard", "std_msgs/msg/String", "data: now", "--once"
        fibaction("topic", "pub", *to_it, *at, code=0)
        called = f"{space}/shout", "test_msgs/srv/BasicTypes", "string_value: a"
        assert "string_value: A" in fibaction("service", "call", *called, *at, code=0)
        node = f"{space}/stock"
        assert "  speed" in fibaction("param", "list", node, *at, code=0)
        fibaction("param", "set", node, "speed", "1.5", *at, code=0)
        told = fibaction("param", "get", node, "speed", *at, code=0)
        assert told == ["Double value is: 1.5"]
    assert texts == ["now"]


def events(lines: list[str]) -> list[dict[str, object]]:
    return [json.loads(line) for line in lines]


def test_an_action_is_listed_with_its_type_and_its_nodes() -> None:
    assert "/fibonacci [arduinobot_msgs/action/Fibonacci]" in fibaction("list", "-t", code=0)
    assert fibaction("type", "fibonacci", code=0) == ["arduinobot_msgs/action/Fibonacci"]
    assert fibaction("find", "arduinobot_msgs/action/Fibonacci", code=0) == ["/fibonacci"]
    lines = fibaction("info", "/fibonacci", code=0)
    assert "Action servers: 1" in lines


def test_a_goal_is_sent_and_followed_to_its_end() -> None:
    told = events(fibaction("send_goal", "fibonacci", "order: 4", "-f", "--json", code=0))
    feedback = [event["feedback"] for event in told if event["event"] == "feedback"]
    assert feedback[-1] == {"partial_sequence": [0, 1, 1, 2, 3]}
    assert told[-1]["status"] == "SUCCEEDED"


def test_a_goal_that_is_rejected_or_does_not_fit_ends_with_its_own_exit_code() -> None:
    fibaction("send_goal", "fibonacci", "order: -1", code=4)
    fibaction("send_goal", "fibonacci", "ordr: 1", code=2)
    fibaction("send_goal", "fibonacci", "order: 99999999999", code=2)


@pytest.mark.parametrize(
    "command",
    [
        [COMMAND, "serve", "fibonacci:make_server", "ros2://"],
        [sys.executable, "fibonacci_server.py", "--url", "ros2://"],
    ],
    ids=["serve", "example"],
)
def test_a_server_starts_with_the_arguments_of_ros2_run(command: list[str | Path]) -> None:
    place = f"/started_{uuid.uuid4().hex[:8]}"
    rules = ["--ros-args", "-r", f"__ns:={place}", "-r", "__node:=mine"]
    process = subprocess.Popen(
        [*command, *rules],
        cwd=ROOT / "examples",
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with process:
        try:
            assert process.stdout is not None
            assert f" at ros2://?namespace={place}, Ctrl-C" in process.stdout.readline()
            found = subprocess.run(
                [COMMAND, "info", f"{place}/fibonacci", "-u", URL],
                capture_output=True,
                text=True,
                timeout=PATIENCE,
            )
            assert f"{place}/mine" in found.stdout
        finally:
            process.kill()
