"""`examples/ros2/fibaction_fibonacci`, as far as it can be checked without colcon and launch."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import uuid
from pathlib import Path
from types import ModuleType
from typing import Any

import anyio
import pytest
import setuptools
from catkin_pkg.package import parse_package

from fibaction import connect
from tests.support.fibonacci import FIBONACCI, Goal, Result
from tests.support.processes import ended, lines_until

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
