"""The example over ROS 2, server and clients as processes, the way users run them."""

from __future__ import annotations

import subprocess
import sys
import uuid
from pathlib import Path
from signal import SIGTERM

from tests.support.processes import PATIENCE, ended, lines_until

EXAMPLES = Path(__file__).parents[2] / "examples"
NO_REASON = "the server rejected it; ROS 2 transmits no reason, but the server's log may have it"
# What parses the interfaces of ROS 2 imports a module of `re` by its old name.
STRICT = ("-W", "error", "-W", "ignore:module 'sre_:DeprecationWarning")


def start(script: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, *STRICT, str(EXAMPLES / script), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_goal_succeeds_and_another_is_rejected_and_the_server_says_why() -> None:
    url = f"ros2://?namespace=/n{uuid.uuid4().hex}"
    server = start("fibonacci_server.py", "--url", url, "--period", "0")
    try:
        announced = lines_until("^serving", server)
        there = f"{url}&discovery_timeout={PATIENCE}"
        clients = [
            start("fibonacci_client.py", "--url", there, "--order", order) for order in ("4", "47")
        ]
        (code, out, err), (rejected, told, complaint) = map(ended, clients)
        server.send_signal(SIGTERM)
        _, log = server.communicate(timeout=PATIENCE)
    finally:
        server.kill()

    assert announced == [f"serving fibonacci at {url}, Ctrl-C stops it\n"]
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
