"""`examples/ros2/fibaction_fibonacci`, as far as it can be checked without colcon and launch."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import uuid
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest
import setuptools
import yaml
from catkin_pkg.package import parse_package

from fibaction import connect
from tests.ros2.stock.process import peer
from tests.support.fibonacci import FIBONACCI, Goal, Result
from tests.support.pages import blocks_of
from tests.support.processes import ended, lines_until
from tests.test_docs import DOCS

PACKAGE = Path(__file__).parents[2] / "examples/ros2/fibaction_fibonacci"
NAME = PACKAGE.name
STRICT = ("-W", "error", "-W", "ignore:module 'sre_:DeprecationWarning")


@pytest.fixture
def setup(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the package tells setuptools."""
    told: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, "setup", told.update)
    exec(compile((PACKAGE / "setup.py").read_text(), "setup.py", "exec"), {"__name__": "setup"})
    return told


def test_the_manifest_is_valid_and_agrees_with_what_is_installed(setup: dict[str, Any]) -> None:
    manifest = parse_package(str(PACKAGE))
    assert manifest.get_build_type() == "ament_python"
    assert (manifest.name, manifest.version) == (NAME, setup["version"]) == (NAME, "0.1.0")
    installed = {file for _, files in setup["data_files"] for file in files}
    assert installed == {f"resource/{NAME}", "package.xml", "launch/two_robots.launch.py"}
    for file in installed:
        assert (PACKAGE / file).exists()


def test_the_manifest_names_fibaction_and_rosdep_has_a_rule_for_it() -> None:
    needed = {one.name for one in parse_package(str(PACKAGE)).exec_depends}
    rules = yaml.safe_load((PACKAGE.parent / "rosdep.yaml").read_text(encoding="utf-8"))

    assert "fibaction" in needed
    assert rules["fibaction"]["ubuntu"] == {"pip": {"packages": ["fibaction"]}}


def test_the_installed_node_is_run_by_the_python_of_the_environment(tmp_path: Path) -> None:
    source, prefix, python = tmp_path / "source", tmp_path / "install", tmp_path / "bin/python3"
    shutil.copytree(PACKAGE, source)
    # As colcon does it, with the Python that runs colcon.
    command = ["setup.py", "-q", "build", "install", "--prefix", str(prefix), "--record", "record"]
    subprocess.run(
        [sys.executable, *command, "--single-version-externally-managed"],
        cwd=source,
        check=True,
        capture_output=True,
    )
    python.parent.mkdir()
    python.write_text('#!/bin/sh\necho "this Python runs $1"\n', encoding="utf-8")
    python.chmod(0o755)
    node = prefix / "lib" / NAME / "fibonacci_node"
    path = os.pathsep.join((str(python.parent), os.environ["PATH"]))
    run = subprocess.run(
        [node], env={**os.environ, "PATH": path}, check=True, capture_output=True, text=True
    )
    assert run.stdout == f"this Python runs {node}\n"


async def run_at_the_tutorial_server(command: list[str], folder: Path) -> str:
    """Run a client, and return what it prints."""
    async with peer("tutorial_server"):
        return (await anyio.run_process(command, cwd=folder)).stdout.decode()


def test_the_client_in_a_package_of_ones_own_is_as_the_page_says(
    tmp_path: Path, alone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", alone)
    page = blocks_of((DOCS / "howto" / "colcon.md").read_text(encoding="utf-8"))
    (code,) = (block.code for block in page if "def main" in block.code)
    (script,) = (block.code for block in page if ":main" in block.code)
    (printed,) = (block.code for block in page if block.code.startswith("Fibonacci_Feedback"))
    module = script.partition("my_package.")[2].partition(":")[0]
    here = code.replace('name="fibonacci"', 'name="tutorial"')
    (tmp_path / f"{module}.py").write_text(here, encoding="utf-8")
    command = [sys.executable, "-c", f"from {module} import main; main()"]

    assert anyio.run(run_at_the_tutorial_server, command, tmp_path) == printed


async def call(url: str) -> Result:
    async with connect(url, FIBONACCI) as client:
        return await client.call(Goal(2))


def test_the_node_serves_in_the_namespace_that_a_launch_file_gives_it(
    setup: dict[str, Any],
) -> None:
    (script,) = setup["entry_points"]["console_scripts"]
    module, _, function = script.partition(" = ")[2].partition(":")
    space = f"/n{uuid.uuid4().hex}"
    code = f"from {module} import {function}; {function}()"
    process = subprocess.Popen(
        [sys.executable, *STRICT, "-c", code, "--ros-args", "-r", f"__ns:={space}"],
        cwd=PACKAGE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        (line,) = lines_until("^serving", process)
        assert line == f"serving fibonacci at ros2://?namespace={space}\n"
        assert anyio.run(call, f"ros2://?namespace={space}") == Result([0, 1, 1])
        process.terminate()
        assert ended(process)[0] == 0
    finally:
        process.kill()


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for the packages `launch` and `launch_ros`, which are not in the wheels."""
    packages = {name: ModuleType(name) for name in ("launch", "launch_ros", "launch_ros.actions")}
    packages["launch"].LaunchDescription = list  # type: ignore[attr-defined]  # a stand-in
    packages["launch_ros.actions"].Node = dict  # type: ignore[attr-defined]  # as above
    for name, module in packages.items():
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.usefixtures("launch")
def test_the_launch_file_starts_the_node_that_is_installed(setup: dict[str, Any]) -> None:
    spec = importlib.util.spec_from_file_location("two", PACKAGE / "launch/two_robots.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    nodes: Any = module.generate_launch_description()
    assert [node["namespace"] for node in nodes] == ["robot1", "robot2"]
    names = [script.partition(" = ")[0] for script in setup["entry_points"]["console_scripts"]]
    for node in nodes:
        assert node["package"] == NAME
        assert node["executable"] in names
