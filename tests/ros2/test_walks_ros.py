"""The pages that are followed in terminals, where ROS 2 is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.ros2.test_node_pages import PAGES as WITH_NODES
from tests.ros2.test_robot_pages import PAGES as WITH_ROBOTS
from tests.support.pages import blocks_of
from tests.support.walks import file_of, walk
from tests.test_docs import DOCS, PAGES, ROOT

WITH_OTHERS = WITH_ROBOTS.union(WITH_NODES)
"""The pages whose programs need other nodes around them, and have tests with these."""
WALKS = [
    path
    for path in PAGES
    if ", where ROS 2 is -->" in path.read_text(encoding="utf-8") and path.stem not in WITH_OTHERS
]
PAGE = DOCS / "first_action.md"
PACKAGE = "drive_msgs"
"""The interface package that `PAGE` has its reader write."""


@pytest.fixture(scope="module")
def drive_msgs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The interface package that the page writes, built as the page does it.

    It takes half a minute, and stays in the environment: so only if the page has another one.
    """
    folder = tmp_path_factory.mktemp("package")
    changed = False
    for block in blocks_of(PAGE.read_text(encoding="utf-8")):
        marked = file_of(block)
        if marked is None or not marked["path"].startswith(f"{PACKAGE}/"):
            continue
        path = folder / marked["path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.code, encoding="utf-8")
        installed = Path(sys.prefix, "share", marked["path"])
        if path.name != "CMakeLists.txt":  # it is not installed
            changed |= not installed.exists() or installed.read_text("utf-8") != block.code
    if changed:
        script = ROOT / "examples" / "ros2" / "build_interfaces.py"
        built = subprocess.run(
            [sys.executable, script, PACKAGE], cwd=folder, capture_output=True, text=True
        )
        package = folder / PACKAGE
        assert built.stdout == f"{package} is built, and installed in {sys.prefix}\n", built.stderr


@pytest.mark.timeout(240, method="thread")  # it may build a package, and starts ten processes
@pytest.mark.usefixtures("drive_msgs")
@pytest.mark.parametrize("path", WALKS, ids=[path.stem for path in WALKS])
def test_a_reader_with_ros_who_types_what_the_page_says_sees_what_it_shows(
    path: Path, tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)  # pages list all actions of the graph
    wrong = walk(path.read_text(encoding="utf-8"), tmp_path, ros=True)

    assert not wrong, "\n".join(wrong)


def test_the_way_to_an_action_of_ones_own_is_among_them() -> None:
    assert PAGE in WALKS
