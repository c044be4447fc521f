"""Packages of interface files: their names, and where their messages are."""

from __future__ import annotations

from pathlib import Path

import pytest

from fibaction.interfaces import packages
from fibaction.interfaces.files import read_action
from fibaction.interfaces.packages import SearchPath, manifest_name, package_of
from tests.support.interface_files import write

GOAL = "robot_msgs/Load load\n---\n---\n"


def package(folder: Path, name: str, message: str = "Load") -> Path:
    """Make a package in a folder, with an empty message."""
    write(folder / "package.xml", f"<package>\n  <name>{name}</name>\n</package>\n")
    write(folder / "msg" / f"{message}.msg", "")
    return folder


def action(folder: Path, text: str = GOAL) -> Path:
    return write(folder / "action" / "Lift.action", text)


def test_a_package_has_the_name_in_its_manifest(tmp_path: Path) -> None:
    path = action(package(tmp_path / "cloned-robot", "robot_msgs"))

    found = read_action(path)

    assert found.type_name == "robot_msgs/action/Lift"
    assert found.goal.nested["load"].type_name == "robot_msgs/msg/Load"


def test_an_own_message_is_found_without_its_package(tmp_path: Path) -> None:
    path = action(package(tmp_path / "Clone", "robot_msgs"), "Load a\n---\n---\n")

    assert read_action(path).goal.nested["a"].type_name == "robot_msgs/msg/Load"


def test_a_package_beside_that_of_the_file_has_the_name_in_its_manifest(tmp_path: Path) -> None:
    package(tmp_path / "cloned", "robot_msgs")
    path = action(package(tmp_path / "lift", "lift_msgs", "Other"))

    assert read_action(path).goal.nested["load"].package == "robot_msgs"


@pytest.mark.parametrize("search", [".", "src/group/cloned", "src/group/cloned/msg", "src/group"])
def test_the_search_path_may_name_a_workspace_a_package_or_its_messages(
    tmp_path: Path, search: str
) -> None:
    package(tmp_path / "ws/src/group/cloned", "robot_msgs")
    path = action(tmp_path / "lift_msgs")

    found = read_action(path, search=[tmp_path / "ws" / search])

    assert found.goal.nested["load"].package == "robot_msgs"


@pytest.mark.parametrize("search", [".", "cloned", "share"])
def test_a_message_may_be_in_a_folder_within_the_messages_of_its_package(
    tmp_path: Path, search: str
) -> None:
    grouped = package(tmp_path / "cloned", "robot_msgs", "Other") / "msg/arm"
    installed = tmp_path / "share/robot_msgs/arm"
    for folder in (grouped, installed):
        write(folder / "Load.msg", "int32 kilograms\n")

    found = read_action(action(tmp_path / "elsewhere/lift_msgs"), search=[tmp_path / search])

    load = found.goal.nested["load"]
    assert load.type_name == "robot_msgs/msg/Load"
    assert load.definition.path.parent == (installed if search == "share" else grouped)


@pytest.mark.parametrize("folder", ["build/a", "install/a", ".git/a", "ignored/a"])
def test_what_a_build_does_not_look_into_is_not_searched(tmp_path: Path, folder: str) -> None:
    package(tmp_path / folder, "robot_msgs")
    write(tmp_path / "ignored" / "COLCON_IGNORE", "")

    assert not any(one.is_file() for one in places([tmp_path]))


def test_the_search_in_a_workspace_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package(tmp_path / "a/b", "robot_msgs")
    package(tmp_path / "1/2/3/4/5/6", "robot_msgs")
    (deep,) = (one for one in places([tmp_path]) if one.is_file())
    assert deep == tmp_path / "a/b/msg/Load.msg"

    monkeypatch.setattr(packages, "MAX_FOLDERS", 2)

    assert not any(one.is_file() for one in places([tmp_path]))


def places(search: list[Path]) -> list[Path]:
    return list(SearchPath([], search).places("robot_msgs", "Load"))


def test_a_folder_that_is_missing_has_no_packages(tmp_path: Path) -> None:
    assert not any(one.is_file() for one in places([tmp_path / "missing"]))


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("<package><!-- <name>other</name> --><name> robot_msgs </name></package>", "robot_msgs"),
        ("<package></package>", ""),
        ("<package><name>Not-A-Name</name></package>", ""),
        ('\n<?xml version="1.0" encoding="shift_jis"?><package><name> a </name>&</package>', "a"),
        ("<package><!-- <name>b</name> --><!-- <!-- --><name>a</name></package>", "a"),
        ("<name" * 50_000, ""),
        ("<!--" * 50_000 + "<name>a</name>", ""),
    ],
)
def test_a_manifest_has_a_name_or_none(tmp_path: Path, text: str, name: str) -> None:
    (tmp_path / "package.xml").write_text(text)

    assert manifest_name(tmp_path) == name


def test_an_action_file_elsewhere_is_of_no_package(tmp_path: Path) -> None:
    assert package_of(tmp_path / "Lift.action") == ""
    assert package_of(tmp_path / "Not-A-Name" / "action" / "Lift.action") == ""
    assert package_of(tmp_path / "lift_msgs" / "action" / "Lift.action") == "lift_msgs"
