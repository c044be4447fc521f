"""The values of parameters that come by arguments and by files, at a node over our own DDS."""

from __future__ import annotations

import sys
from pathlib import Path

import anyio
import pytest

from fibaction import TransportError
from fibaction_transports.ros2.on_dds.node import DdsAdapter, DdsSettings
from fibaction_transports.ros2.settings import NodeSettings
from fibaction_transports.ros2.without_ros.ros_arguments import (
    overrides_of,
    read_arguments,
    read_parameters_file,
)
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.processes import PATIENCE


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "robot.yaml"


def of_arm(file: Path, text: str) -> dict[str, object]:
    """Return the parameters that a file has for the node `/robot/arm`."""
    file.write_text(text)
    found = overrides_of("/robot/arm", read_parameters_file(str(file)))
    return {name: one.value for name, one in found.items()}


@pytest.mark.parametrize(
    "nodes",
    ["/robot/arm", "robot/arm", "/**", "/*/arm", "/*/*", "/**/arm", "/robot/**", "/robot/*"],
)
def test_a_file_names_nodes_by_their_full_names_or_by_patterns(nodes: str, file: Path) -> None:
    assert of_arm(file, f"{nodes}:\n  ros__parameters:\n    speed: 2.5\n") == {"speed": "2.5"}


@pytest.mark.parametrize("nodes", ["arm", "/arm", "/robot", "/*", "/robot/arm/*", "/robot/ar"])
def test_parameters_of_other_nodes_are_left_alone(nodes: str, file: Path) -> None:
    assert of_arm(file, f"{nodes}:\n  ros__parameters:\n    speed: 2.5\n") == {}


def test_namespaces_may_be_levels_of_the_file(file: Path) -> None:
    text = """
    robot:
      leg: {ros__parameters: {speed: 1}}
      arm:
        ros__parameters:
          speed: 2
          joints: [a, b]
          gains: {p: 3}
    """
    assert of_arm(file, text) == {"speed": "2", "joints": ["a", "b"], "gains.p": "3"}


@pytest.mark.parametrize("text", ["", "---\n", "# nothing\n"])
def test_an_empty_file_has_no_parameters(text: str, file: Path) -> None:
    assert of_arm(file, text) == {}


def test_the_last_value_counts_by_the_place_where_its_nodes_were_first_named(file: Path) -> None:
    file.write_text(
        "/**: {ros__parameters: {a: of all, b: of all}}\n"
        "/robot/arm: {ros__parameters: {a: of arm}}\n"
    )
    words = ["-p", "c:=1", "--params-file", str(file), "-p", "a:=late", "-p", "b:=late"]
    arguments = read_arguments(["--ros-args", *words, "-p", "c:=2"])
    found = overrides_of("/robot/arm", arguments.parameters)
    assert {name: one.value for name, one in found.items()} == {
        "a": "of arm",
        "b": "late",
        "c": "2",
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a: b: c", "not valid YAML: mapping values are not allowed here in"),
        ("- a", "\"['a']\" at its top: expected the names of nodes, each with ros__parameters"),
        ("speed: 2", "'2' at /speed: expected the names of nodes"),
        ("ros__parameters: {a: 1}", "'' is not the name of a node: expected the names"),
        ("a b: {ros__parameters: {a: 1}}", "'/a b' is not the name of a node: expected"),
        ("/a/: {ros__parameters: {a: 1}}", "'/a/' is not the name of a node: expected"),
        ("arm: {ros__parameters: }", "'' at /arm: expected the names"),
        ("arm: &a {ros__parameters: {}}\nleg: *a", "it has the alias *a, as no file for ROS"),
        ("[a]: b", "not valid YAML: while constructing a mapping found"),
        ("a: 1\n--- b", "not valid YAML: expected a single document"),
        ("[" * 50_000, "too many levels"),
        ("\0", "not valid YAML: unacceptable character"),
    ],
)
def test_a_file_that_is_wrong_is_an_error_of_one_sentence(
    text: str, problem: str, file: Path
) -> None:
    with pytest.raises(TransportError) as caught:
        of_arm(file, text)
    assert str(caught.value).startswith(f"--params-file {str(file)!r}: {problem}")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_an_error() -> None:
    with pytest.raises(TransportError, match=r"^--params-file 'no\.yaml': No such file or dir"):
        read_arguments(["--ros-args", "--params-file", "no.yaml"])


def test_without_pyyaml_the_error_says_how_to_install_it(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(TransportError) as caught:
        of_arm(file, "")
    assert str(caught.value) == "--params-file needs yaml: pip install 'fibaction[cli]'"


def adapter(*words: str) -> DdsAdapter:
    node = NodeSettings("arm", "robot", None, ["--ros-args", *words])
    return DdsAdapter(node, DdsSettings(discovery="LOCALHOST"))


@pytest.mark.anyio
@pytest.mark.parametrize(("word", "is_simulated"), [("true", True), ("Yes", True), ("off", False)])
async def test_a_node_begins_with_the_simulated_time_of_its_file(
    word: str, *, is_simulated: bool, file: Path
) -> None:
    parameters = f"{{use_sim_time: {word}, speed: 2}}"
    of_arm(file, f"/robot/arm: {{ros__parameters: {parameters}}}")
    with anyio.fail_after(PATIENCE):
        async with adapter("--params-file", str(file)).open() as node:
            assert node.clock.is_the_machines is not is_simulated


@pytest.mark.anyio
async def test_a_simulated_time_that_is_not_a_bool_is_an_error(file: Path) -> None:
    of_arm(file, "/**: {ros__parameters: {use_sim_time: 3}}")
    with pytest.raises(TransportError) as caught:
        async with adapter("--params-file", str(file)).open():
            pass  # pragma: no cover  # the block is never entered
    told = f"use_sim_time is '3' in --params-file {str(file)!r}: expected true or false"
    assert str(caught.value) == told
