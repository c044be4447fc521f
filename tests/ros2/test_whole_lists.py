"""The first look of a process at the graph has all robots: stock servers, each in a process."""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack

import anyio
import pytest

from fibaction.cli.process.exit_codes import ExitCode
from tests.ros2.stock.process import peer
from tests.ros2.test_cli import COMMAND

pytestmark = pytest.mark.anyio

ROBOTS = 3
LISTS = 4
PATIENCE = 120.0
"""Seconds for all commands of a test, on a machine that is busy."""


@pytest.fixture(scope="module")
async def robots(anyio_backend: str) -> AsyncGenerator[None, None]:
    async with AsyncExitStack() as stack:
        for number in range(ROBOTS):
            await stack.enter_async_context(peer("robot", f"/robot{number}"))
        yield


async def fibaction(*arguments: str) -> tuple[int, str]:
    """Run the command in a new process; return its exit code, and what it printed."""
    done = await anyio.run_process([str(COMMAND), *arguments], check=False, env=dict(os.environ))
    return done.returncode, (done.stdout + done.stderr).decode().strip()


@pytest.mark.parametrize("url", ["ros2://?via=rclpy", "dds://"])
async def test_every_list_is_complete(robots: None, url: str) -> None:
    with anyio.fail_after(PATIENCE):
        for _ in range(LISTS):
            assert await fibaction("-u", url, "list", "-c") == (0, str(ROBOTS))


@pytest.mark.parametrize("url", ["ros2://?via=rclpy", "dds://"])
async def test_a_namespace_is_listed_and_a_wrong_one_is_told(robots: None, url: str) -> None:
    with anyio.fail_after(PATIENCE):
        listed = await fibaction("-u", url, "list", "-n", "/robot1")
        code, text = await fibaction("-u", url, "list", "-n", "/robt1")
    assert listed == (0, "/robot1/fibonacci")
    assert code == ExitCode.UNREACHABLE
    assert "there is no action in the namespace /robt1; did you mean /robot1?" in text
