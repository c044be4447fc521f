"""The programs of pages about robots, with servers of rclpy in the place of the robot."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from subprocess import PIPE
from tempfile import TemporaryFile

import anyio
import pytest
from anyio.streams.text import TextReceiveStream

from tests.ros2.stock.process import PATIENCE, peer
from tests.support.pages import blocks_of, programs_of
from tests.support.walks import file_of, walk
from tests.test_docs import DOCS

pytestmark = pytest.mark.anyio
HOWTO = DOCS / "howto"
ROBOTS = ("nav2", "arm", "turtle")
"""The modules in `tests/ros2/stock` with servers, and the parts of pages that use them."""
_SECTIONS = {
    "arm": ("nav2", "MoveIt, ros2_control, behaviour trees"),
    "async_node": ("rclpy_node", "With rclpy's AsyncNode"),
    "turtle": ("ros2_without_ros", "A robot without ROS"),
}
"""Parts with robots or nodes of their own: the page of each, and its heading."""
PAGES = frozenset(_SECTIONS.get(robot, (robot, ""))[0] for robot in ROBOTS)
"""The pages with these parts."""
both_ways = pytest.mark.parametrize("url", ["ros2://", "dds://"])


def part_of(name: str) -> str:
    """Return a page without its sections in `_SECTIONS`, or one of these."""
    page, heading = _SECTIONS.get(name, (name, None))
    text = (HOWTO / f"{page}.md").read_text(encoding="utf-8")
    ((_, known),) = (one for one in _SECTIONS.values() if one[0] == page)
    before, found, section = text.partition(f"\n## {known}\n")
    assert found
    return section.partition("\n## ")[0] if heading else before


def page_of(name: str, url: str) -> str:
    """Return the text of a part whose programs use a URL of this kind."""
    text = part_of(name)
    text, count = re.subn('"(ros2|dds)://"', f'"{url}"', text)
    assert count
    return text


@both_ways
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.timeout(120, method="thread")  # it starts several processes, one after another
async def test_the_programs_of_pages_about_a_robot_print_what_they_show(
    robot: str, url: str, tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)
    wrong: list[str] = []

    async def follow(number: int, part: str) -> None:
        folder = tmp_path / str(number)
        folder.mkdir()
        walked = partial(walk, part, folder, ros=True)
        wrong.extend(await anyio.to_thread.run_sync(walked))

    async with peer(robot), anyio.create_task_group() as tasks:
        for number, part in enumerate(programs_of(page_of(robot, url))):
            tasks.start_soon(follow, number, part)
    assert not wrong, "\n".join(wrong)


@asynccontextmanager
async def program(page: str, name: str, folder: Path) -> AsyncGenerator[TextReceiveStream, None]:
    """Run a program of a page, and give its output."""
    for block in blocks_of(page):
        if (marked := file_of(block)) is not None:
            (folder / marked["path"]).write_text(block.code, encoding="utf-8")
    with TemporaryFile() as errors:
        command = [sys.executable, "-u", name]
        async with await anyio.open_process(
            command, cwd=folder, stdout=PIPE, stderr=errors, env=dict(os.environ)
        ) as process:
            assert process.stdout is not None
            try:
                yield TextReceiveStream(process.stdout)
            finally:
                process.kill()


async def until(output: TextReceiveStream, pattern: str) -> None:
    """Read the output until it matches."""
    text = ""
    with anyio.fail_after(PATIENCE):
        while not re.search(pattern, text, re.DOTALL):
            text += await output.receive()


@both_ways
@pytest.mark.timeout(120, method="thread")
async def test_the_patrol_goes_on_when_nav2_is_there_again(
    url: str, tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)
    async with program(page_of("nav2", url), "patrol.py", tmp_path) as output:
        async with peer("nav2"):
            await until(output, "door: visited\nkitchen: visited\n")
        await until(output, ": Nav2 is away\n")
        async with peer("nav2"):
            await until(output, "door: visited\n.*kitchen: visited\n")
