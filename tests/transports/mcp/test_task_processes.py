"""A task whose client is killed, and whose server is killed: another client reads its result."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.ports import free_port

ROOT = Path(__file__).resolve().parents[3]
TOKEN = "tW4x9c-tW4x9c"


@contextmanager
def running(module: str, *arguments: str) -> Generator[subprocess.Popen[str], None, None]:
    """Run a module of this folder; kill it at the end of the block, as SIGKILL does."""
    process = subprocess.Popen(
        [sys.executable, "-m", f"tests.transports.mcp.{module}", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'transports'}"},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process prints; an error if it has ended."""
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    assert line, f"the process ended with {process.wait()}"
    return line


@pytest.mark.timeout(180)
def test_a_second_client_reads_the_result_after_both_ends_were_killed(tmp_path: Path) -> None:
    address = str(free_port()), TOKEN, str(tmp_path / "goals.db")
    with running("task_server", *address) as server:
        url = line_of(server)
        with running("task_client", url, TOKEN, "start", "5") as first:
            task, news = line_of(first), line_of(first)
            assert news == "1"  # the goal has a checkpoint by now
    with running("task_server", *address) as server:
        assert line_of(server) == url
        with running("task_client", url, TOKEN, "wait", task) as second:
            ended = json.loads(line_of(second))
        assert (ended["taskId"], ended["status"]) == (task, "completed")
        assert ended["result"]["structuredContent"]["result"] == {"at": 5, "begin": 1}
