"""The examples over ROS 2, server and client as two processes, the way users run them."""

from __future__ import annotations

import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM

import anyio
import pytest

from fibaction import GoalStatus, Outcome, connect
from tests.support.processes import PATIENCE, ended, lines_until

# Examples are scripts beside each other, and import one another as such.
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import exclusive_arm

from tests.support.matching import End

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK, STEADY, SLOW = 0.0, 0.2, 60.0  # seconds per number
NO_REASON = "the server rejected it; ROS 2 transmits no reason, but the server's log may have it"
# What parses the interfaces of ROS 2 imports a module of `re` by its old name.
STRICT = ("-W", "error", "-W", "ignore:module 'sre_:DeprecationWarning")


def start(script: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, *STRICT, str(EXAMPLES / script), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def start_client(url: str, *arguments: str, patience: float = PATIENCE) -> subprocess.Popen[str]:
    url = f"{url}&discovery_timeout={patience}"
    return start("fibonacci_client.py", "--url", url, *arguments)


@contextmanager
def running(
    script: str, action: str, *arguments: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The server as a process, in a namespace of its own, and its URL."""
    url = f"ros2://?namespace=/n{uuid.uuid4().hex}"
    process = start(script, "--url", url, *arguments)
    try:
        announced = lines_until("^serving", process)
        assert announced == [f"serving {action} at {url}, Ctrl-C stops it\n"]
        yield process, url
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE)


def serving(period: float) -> AbstractContextManager[tuple[subprocess.Popen[str], str]]:
    return running("fibonacci_server.py", "fibonacci", "--period", str(period))


def test_a_goal_succeeds_and_another_is_rejected_and_the_server_says_why() -> None:
    with serving(QUICK) as (server, url):
        clients = [start_client(url, "--order", order) for order in ("4", "47")]
        (code, out, err), (rejected, told, complaint) = map(ended, clients)
        server.send_signal(SIGTERM)
        _, log = server.communicate(timeout=PATIENCE)

    assert (code, err) == (0, "")
    lines = out.splitlines()
    goal_id = lines.pop(1).removeprefix("accepted  ")
    assert lines == [
        "goal      order 4",
        "feedback  0 1 1",
        "feedback  0 1 1 2",
        "feedback  0 1 1 2 3",
        "succeeded",
        "result    0 1 1 2 3",
    ]
    assert f"goal {goal_id} SUCCEEDED" in log

    assert (rejected, complaint) == (4, "")
    assert told.splitlines() == [
        "goal      order 47",
        f"rejected  {NO_REASON}",
    ]
    (warning,) = (line for line in log.splitlines() if line.startswith("[WARN]"))
    assert warning.endswith(
        "rejected: order is 47, and the numbers after index 46 do not fit int32"
    )
    assert server.returncode == 0
    assert "Traceback" not in log


def test_ctrl_c_cancels_the_goal_and_what_there_was_is_printed() -> None:
    with serving(SLOW) as (_, url):
        client = start_client(url)
        lines_until("^accepted", client)
        client.send_signal(SIGINT)
        code, out, err = ended(client)

    assert (code, err) == (3, "")
    # The answer to the cancel and the end of the goal come by two services, in either order.
    lines = out.splitlines()
    assert [line for line in lines if line != "cancel    accepted"] == ["canceled", "result    0 1"]


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_a_server_that_is_stopped_ends_its_goals_and_leaves_nothing_behind(number: int) -> None:
    with serving(SLOW) as (server, url):
        client = start_client(url)
        lines_until("^accepted", client)
        server.send_signal(number)
        code, out, err = ended(client)
        _, log = server.communicate(timeout=PATIENCE)

    assert (code, err) == (1, "")
    assert out.splitlines() == ["aborted", "result    0 1"]  # ROS transmits no reason
    assert server.returncode == 0
    assert " action server 'fibonacci' has stopped\n" in log
    assert " ABORTED: server stopped\n" in log
    assert not [word for word in ("Traceback", "terminate called", "dumped") if word in log]


def test_a_client_ends_when_the_server_is_killed() -> None:
    with serving(STEADY) as (server, url):
        client = start_client(url, "--order", "46", patience=6)
        lines_until("^feedback  0 1 1 2 3 5 8", client)  # signs of life have been heard by then
        server.send_signal(SIGKILL)
        code, _, err = ended(client)

    assert code == 6
    assert err.splitlines()[-1] == "error: the server of 'fibonacci' has gone away"


def test_a_client_without_a_server_says_so_in_one_line() -> None:
    name = f"n{uuid.uuid4().hex}"
    client = start_client(f"ros2://?namespace=/{name}", patience=0.1)
    code, out, err = ended(client)

    assert (code, out) == (6, "goal      order 10\n")
    assert err.startswith("error: no server of the action 'fibonacci' in ROS: ")
    assert f"/{name}/fibonacci" in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("script", ["fibonacci_client.py", "fibonacci_server.py"])
@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("ros2://?domain_id=many", "the setting 'domain_id' cannot be 'many'"),
        ("ros2://two%20words", "two%20words"),
    ],
)
def test_a_url_that_cannot_be_used_is_one_line_and_an_exit_code(
    script: str, url: str, error: str
) -> None:
    code, out, err = ended(start(script, "--url", url))

    assert (code, out) == (2, "")
    # The server logs its end as well, if it had begun before ROS said no.
    *_, last = err.splitlines()
    assert error in last
    assert "error: " in last


async def send_and_preempt(url: str) -> list[Outcome[exclusive_arm.Result]]:
    """Send a goal to the arm, and another one when it moves; return both ends."""
    async with connect(url, exclusive_arm.Arm.move) as client:
        await client.wait_for_server(PATIENCE)
        first = await client.send_goal(exclusive_arm.Goal([1.5, 0.0, 0.0]))
        await anext(aiter(first.feedback))
        second = await client.send_goal(exclusive_arm.Goal([0.0, 0.2, 0.0]))
        return [await first.outcome(), await second.outcome()]


def test_a_new_goal_preempts_the_one_before_it_and_gets_its_arm() -> None:
    with running("exclusive_arm.py", "move_arm") as (server, url):
        preempted, ended_well = anyio.run(send_and_preempt, url)
        server.send_signal(SIGTERM)
        _, log = server.communicate(timeout=PATIENCE)

    assert preempted.status is GoalStatus.ABORTED
    assert preempted.result is not None
    assert 0 < preempted.result.joints[0] < 1.5
    assert ended_well == End(GoalStatus.SUCCEEDED, exclusive_arm.Result([0.0, 0.2, 0.0]))
    assert " ABORTED: preempted by " in log  # ROS transmits no reason
    assert server.returncode == 0
