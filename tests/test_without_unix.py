"""fibaction on a system that is not Unix: without its modules, its signals and the event
loop's receivers of them. Linux plays such a system, by `tests.support.without_unix`.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import pytest

from tests.support.processes import Finished, ended, lines_until
from tests.support.ros_domain import own_domain

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="Linux plays another system")

ROOT = Path(__file__).resolve().parents[1]
PATHS = os.pathsep.join(map(str, (ROOT, ROOT / "transports")))
TAKEN = "from tests.support.without_unix import take_away; take_away()\n"
COMMAND = f"{TAKEN}from fibaction.cli import main; main()"

Start: TypeAlias = "Callable[..., subprocess.Popen[str]]"

ROBOT = """
import anyio
from fibaction import GoalCanceled, Report, action

@action("drive")
async def drive(meters: int, report: Report[int]) -> str:
    try:
        for done in range(1, meters + 1):
            await report(done)
            if done > 3:  # so that it is on the way for long
                await anyio.sleep(0.1)
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled(result="braked") from None
    return f"drove {meters} m"
"""

IMPORTS = """
import importlib, json, pkgutil
import fibaction, fibaction_transports
seen = []
for package in (fibaction, fibaction_transports):
    names = pkgutil.walk_packages(package.__path__, package.__name__ + ".", lambda name: None)
    for module in names:
        if ".on_rclpy" not in module.name and "__main__" not in module.name:
            importlib.import_module(module.name)
            seen.append(module.name)
print(json.dumps(len(seen)))
"""

LIBRARY = """
import sys
import anyio
from fibaction import ActionServer, connect, serve
from fibaction import SqliteStore
from tests.support.fibonacci import FIBONACCI, Goal, fibonacci

async def main(url):
    server = ActionServer(FIBONACCI, fibonacci, store=SqliteStore("goals.db"))
    async with serve(server, url) as (where,):
        async with connect("dds://" + url[8:] if "dds" in url else where, FIBONACCI) as client:
            await client.wait_for_server()
            seen = []
            result = await client.call(Goal(3), on_feedback=seen.append)
            print(len(seen), result.sequence)

anyio.run(main, sys.argv[1])
"""

BLOCKING = """
from fibaction.blocking import call, serve
from robot import drive

with serve(drive, "tcp://127.0.0.1:0") as (where,):
    print(call(where, drive, 3))
"""

TO_FORBIDDEN = """
from fibaction import connect
try:
    connect("unix:///run/robot.sock")
except Exception as exc:
    print(f"{type(exc).__name__}: {exc}")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a module of a server."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "robot.py").write_text(ROBOT)
    return folder


def started(code: str, *arguments: str, folder: Path, url: str = "") -> subprocess.Popen[str]:
    kept = {name: value for name, value in os.environ.items() if "FIBACTION" not in name}
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**kept, "PYTHONPATH": f"{PATHS}{os.pathsep}{folder}", "FIBACTION_URL": url},
    )


def run(code: str, *arguments: str, folder: Path) -> str:
    done = ended(started(TAKEN + code, *arguments, folder=folder))
    assert done.err == ""
    assert done.code == 0
    return done.out


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[str]:
    """The URL of a server that `fibaction serve` runs; it is stopped by Ctrl-C."""
    process = started(COMMAND, "serve", "robot:drive", "tcp://127.0.0.1:0", folder=folder)
    (line,) = lines_until("serving", process)
    found = re.search(r"tcp://\S+:\d+", line)
    assert found is not None
    yield found[0]
    process.send_signal(signal.SIGINT)
    done = ended(process)
    assert done.code == 0
    assert "Traceback" not in done.err


@pytest.fixture
def fibaction(server: str, folder: Path) -> Iterator[Start]:
    """Starts the command with these words."""
    processes: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        processes.append(started(COMMAND, *words, folder=folder, url=server))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            assert stream is not None
            stream.close()


def interrupted(process: subprocess.Popen[str], pattern: str, *, errors: bool = False) -> Finished:
    """Press Ctrl-C as soon as a line is printed, and wait for the end."""
    lines_until(pattern, process, errors=errors)
    process.send_signal(signal.SIGINT)
    done = ended(process)
    assert "Traceback" not in done.err
    return done


def test_every_module_can_be_imported(folder: Path) -> None:
    # These libraries look at the system by themselves.
    done = ended(started(f"import mcp, textual.app\n{TAKEN}{IMPORTS}", folder=folder))
    assert done.err == ""
    assert json.loads(done.out) > 300


@pytest.mark.parametrize(
    "url",
    [
        "inproc://robot",
        "tcp://127.0.0.1:0",
        "ws://127.0.0.1:0",
        "http://127.0.0.1:0",
        "dds://robot",
    ],
)
def test_a_goal_is_sent_over_every_transport_that_is_not_of_unix(url: str, tmp_path: Path) -> None:
    with own_domain():
        query = f"?search={ROOT / 'examples/ros2'}" if url.startswith("dds") else ""
        assert run(LIBRARY, url + query, folder=tmp_path) == "2 [0, 1, 1, 2]\n"


def test_blocking_servers_and_clients_work(folder: Path) -> None:
    assert run(BLOCKING, folder=folder) == "drove 3 m\n"


def test_a_unix_socket_is_one_sentence(folder: Path) -> None:
    assert run(TO_FORBIDDEN, folder=folder) == (
        "TransportError: unix:///run/robot.sock needs a system with Unix domain sockets, and Python"
        " has none on this one: use tcp://127.0.0.1:7400\n"
    )


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        (("list",), r"^/drive$"),
        (("info", "drive"), r"drive"),
        (("wait", "drive"), r""),
        (("ping",), r"ms"),
        (("send_goal", "drive", "meters: 3", "-f"), r"SUCCEEDED"),
        (("send_goal", "drive", "meters: 3", "--detach"), r"^[0-9a-f]{32}$"),
        (("goals", "drive", "--json"), r""),
        (("store", "given_up", "--help"), r"Usage"),
    ],
)
def test_a_verb_that_ends_by_itself_works(
    words: Sequence[str], printed: str, fibaction: Start
) -> None:
    done = ended(fibaction(*words))
    assert (done.code, done.err) == (0, "")
    assert re.search(printed, done.out, re.MULTILINE)


def test_ctrl_c_cancels_the_goal_that_was_sent(fibaction: Start) -> None:
    done = interrupted(fibaction("send_goal", "drive", "meters: 9999", "-f"), "    3")
    assert done.code == 3
    assert "braked" in done.out
    assert "Canceling goal..." in done.err


def test_ctrl_c_ends_what_follows_a_goal(fibaction: Start) -> None:
    (goal_id,) = ended(fibaction("send_goal", "drive", "meters: 9999", "--detach")).lines
    assert interrupted(fibaction("attach", goal_id), r"    \d").code == 130
    assert interrupted(fibaction("echo", "drive"), r"\d").code == 0
    assert ended(fibaction("cancel", "drive", goal_id)).code == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("bridge", "URL", "tcp://127.0.0.1:0"), "bridging"),
        (("bridge", "URL", "http://127.0.0.1:0", "drive"), "bridging"),
        (("console", "--no-open", "--port", "0"), "console of"),
        (("record", "URL", "today.jsonl"), "recording"),
    ],
)
def test_ctrl_c_stops_what_serves(
    words: Sequence[str], line: str, fibaction: Start, server: str
) -> None:
    process = fibaction(*(server if word == "URL" else word for word in words))
    assert interrupted(process, line).code == 0


def test_a_broker_locks_its_folder(fibaction: Start) -> None:
    first = fibaction("broker", "--port", "0")
    lines_until("broker at", first)
    second = ended(fibaction("broker", "--port", "0"))
    assert second.code == 2
    assert second.err.startswith("Error: another broker uses ")
    first.send_signal(signal.SIGINT)
    assert ended(first).code == 0


def test_reload_says_that_it_is_not_for_this_system(fibaction: Start) -> None:
    done = ended(fibaction("serve", "robot:drive", "tcp://127.0.0.1:0", "--reload"))
    needs = "Error: --reload needs Linux or macOS: stop and start the server instead\n"
    assert (done.code, done.err) == (2, needs)
