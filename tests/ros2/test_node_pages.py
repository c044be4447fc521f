"""The programs of pages about nodes of the user's own, with nodes of rclpy around them."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest
from rclpy import experimental

from tests.ros2.stock import async_node
from tests.ros2.stock.process import Peer, peer
from tests.ros2.stock.waiting import eventually
from tests.ros2.test_robot_pages import page_of, part_of, program, until
from tests.support.walks import walk

pytestmark = pytest.mark.anyio
PAGES = ("rclpy_node", "async_node")
CONFIGURE, ACTIVATE, DEACTIVATE = 1, 3, 4
"""Transitions of a lifecycle node."""
SUCCEEDED, ABORTED = 4, 6


def with_async_node(page: str, folder: Path) -> str:
    """Return the page with an AsyncNode that this release of ROS has: an imitation, if need be."""
    line = "from rclpy.experimental import AsyncNode"
    assert line in page
    if hasattr(experimental, "AsyncNode"):
        return page
    assert async_node.__file__ is not None
    shutil.copy(async_node.__file__, folder)
    return page.replace(line, "from async_node import AsyncNode")


def with_late_odometry(page: str) -> str:
    """Return the page with patience for odometry, which comes late on a busy machine."""
    limit = "self._arrived < 1"
    assert limit in page
    return page.replace(limit, "self._arrived < 20")


@pytest.mark.timeout(240, method="thread")  # it starts ten processes, most of them in turn
async def test_the_programs_of_pages_about_nodes_print_what_they_show(
    tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)
    wrong: list[str] = []
    async with peer("nav2"), peer("base"):
        # In turn: each of them has a robot of its own to drive.
        for name, url in (("rclpy_node", ""), ("async_node", "ros2://"), ("async_node", "dds://")):
            folder = tmp_path / f"{name}_{url[:4]}"
            folder.mkdir()
            if url:
                page = with_async_node(page_of(name, url), folder)
            else:
                page = with_late_odometry(part_of(name))
            walked = partial(walk, page, folder, ros=True)
            wrong.extend(await anyio.to_thread.run_sync(walked))
    assert not wrong, "\n".join(wrong)


async def change(stock: Peer, transition: int) -> None:
    """Let the manager of the lifecycle node change its state."""
    assert await stock.ask("change_state", node="managed", transition=transition)


@pytest.mark.timeout(120, method="thread")
async def test_the_lifecycle_node_serves_only_while_it_is_active(
    tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)
    page = part_of("rclpy_node")

    async def servers() -> Any:
        return await stock.ask("profiles", topic="/fibonacci/_action/status")

    async def feedback() -> Any:
        return await stock.ask("feedback", goal=running["goal"])

    async with program(page, "lifecycle.py", tmp_path) as output, peer("client") as stock:
        await until(output, "ready to be configured\n")
        await change(stock, CONFIGURE)
        assert await servers() == []
        for _ in range(2):
            await change(stock, ACTIVATE)
            await eventually(servers, lambda found: len(found) == 1)
            await eventually(partial(stock.ask, "ready", action="fibonacci"), bool)
            running = await stock.ask("send", action="fibonacci", order=46)
            await stock.ask("request_result", goal=running["goal"])
            await eventually(feedback, bool)
            short = await stock.ask("send", action="fibonacci", order=2)
            end = await stock.ask("result", goal=short["goal"])
            assert end == {"status": SUCCEEDED, "sequence": [0, 1, 1]}
            await change(stock, DEACTIVATE)
            end = await stock.ask("result", goal=running["goal"])
            assert end["status"] == ABORTED
            await eventually(servers, lambda found: not found)
