"""The parts of the documentation that need ROS 2: examples, and the reference of `ros2://`."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import uuid
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import product
from pathlib import Path

import pytest

import fibaction_transports.ros2
from tests import test_docs as docs
from tests.support.processes import Finished, ended

PROGRAMS = docs.DOCS / "coming_from_rclpy.md"
MAKERS = ("rclpy", "fibaction")
SUCCEEDS, IS_CANCELED, IS_REJECTED = GOALS = ("5 0", "46 8", "47 0")
"""Arguments of a client: the order, and the length of the feedback at which it cancels."""
FEEDBACK = ["[0, 1, 1]", "[0, 1, 1, 2]", "[0, 1, 1, 2, 3]", "[0, 1, 1, 2, 3, 5]"]

_PART = re.compile(r"<!-- not run: a part of (\S+), which is run where ROS 2 is -->\n\Z")

pages_with_ros = [path for path in docs.PAGES if docs.WITH_ROS in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", pages_with_ros, ids=[path.stem for path in pages_with_ros])
def test_every_example_that_needs_ros_runs_and_prints_what_the_page_shows(path: Path) -> None:
    wrong = docs.run_page(path.read_text(encoding="utf-8"), path.name, ros=True)

    assert not wrong, "\n".join(wrong)


def test_there_are_pages_with_examples_that_need_ros() -> None:
    assert docs.DOCS / "transports.md" in pages_with_ros


def test_the_public_names_are_in_the_reference() -> None:
    page = (docs.DOCS / "reference" / "transports.md").read_text(encoding="utf-8")
    documented = re.findall(r"^::: (fibaction_transports\.ros2\.\S+)$", page, re.MULTILINE)

    assert (
        sorted(name.rpartition(".")[2] for name in documented) == fibaction_transports.ros2.__all__
    )
    assert all(docs.resolve(name) is not None for name in documented)


# The programs that "Coming from rclpy" sets side by side


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with the programs, each put together from its parts on the page."""
    parts: dict[str, list[str]] = {}
    for block in docs.blocks_of(PROGRAMS.read_text(encoding="utf-8")):
        if marked := _PART.search(block.before):
            parts.setdefault(marked[1], []).append(block.code)
    folder = tmp_path_factory.mktemp("programs")
    for name, codes in parts.items():
        (folder / name).write_text("\n".join(codes), encoding="utf-8")
    return folder


def start(program: Path, namespace: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(program), *arguments, "--ros-args", "-r", f"__ns:={namespace}"]
    return subprocess.Popen(
        command, cwd=program.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.fixture(scope="module")
def stories(programs: Path) -> Mapping[tuple[str, str, str], list[str]]:
    """Return the lines that each client prints of each goal, by the makers of server and client."""
    servers = {maker: f"/{maker}_{uuid.uuid4().hex[:8]}" for maker in MAKERS}
    with ExitStack() as stack:
        serving = [
            start(programs / f"{maker}_server.py", where) for maker, where in servers.items()
        ]
        for process in serving:
            stack.callback(ended, process)
            stack.callback(process.send_signal, signal.SIGINT)
        ends: dict[tuple[str, str, str], Finished] = {}
        for (server, where), client in product(servers.items(), MAKERS):
            program = programs / f"{client}_client.py"
            # At once, as they spend their time waiting; but not all pairs, as each that starts
            # keeps the others from being found.
            asking = {goal: start(program, where, *goal.split()) for goal in GOALS}
            for goal, process in asking.items():
                try:
                    ends[server, client, goal] = ended(process)
                except subprocess.TimeoutExpired:
                    # An answer that the server sends before it has found the reader of answers is
                    # lost, and a client of rclpy waits for it for ever.
                    assert client == "rclpy", f"{server}, {client}, {goal}: it did not end"
                    again = start(program, where, *goal.split())
                    ends[server, client, goal] = ended(again)
        assert [process.poll() for process in serving] == [None, None], "a server has ended"
    for key, (code, _, err) in ends.items():
        assert code == 0, f"{key}: {err}"
    return {key: out.splitlines() for key, (_, out, _) in ends.items()}


every_pair = pytest.mark.parametrize(("server", "client"), list(product(MAKERS, MAKERS)))


@every_pair
def test_a_goal_succeeds_between_every_pair_of_server_and_client(
    stories: Mapping[tuple[str, str, str], list[str]], server: str, client: str
) -> None:
    *feedback, last = stories[server, client, SUCCEEDS]

    assert last == "SUCCEEDED [0, 1, 1, 2, 3, 5]"
    # rclpy does not wait for the connection of its topic, so its first messages may be lost. Its
    # client ends with the result, which may overtake the last messages.
    first = FEEDBACK.index(feedback[0])
    assert feedback == FEEDBACK[first : first + len(feedback)]
    assert client == "rclpy" or feedback[-1] == FEEDBACK[-1]


@every_pair
def test_a_goal_is_canceled_between_every_pair_of_server_and_client(
    stories: Mapping[tuple[str, str, str], list[str]], server: str, client: str
) -> None:
    *_, last = stories[server, client, IS_CANCELED]

    assert re.fullmatch(r"CANCELED \[0, 1, 1, 2, .*\]", last)
    assert len(last.split()) < 40


@every_pair
def test_a_goal_is_rejected_between_every_pair_of_server_and_client(
    stories: Mapping[tuple[str, str, str], list[str]], server: str, client: str
) -> None:
    assert stories[server, client, IS_REJECTED] == ["REJECTED"]
