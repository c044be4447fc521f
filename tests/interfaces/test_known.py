"""The interface files that a program has loaded."""

from __future__ import annotations

from pathlib import Path

from fibaction.action_files import load_action
from fibaction.interfaces.known import known_action


def write(path: Path, field: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"int32 {field}\n---\n---\n")
    return path


def test_a_file_that_was_loaded_is_known_by_its_type(tmp_path: Path) -> None:
    for folder, field in (("one", "x"), ("two", "y")):
        load_action(write(tmp_path / folder / "known_msgs/action/Go.action", field))
    found = known_action("known_msgs/action/Go")
    assert found is not None
    assert [one.name for one in found.goal.definition.fields] == ["y"]


def test_a_file_without_a_package_is_not_known(tmp_path: Path) -> None:
    load_action(write(tmp_path / "Lost.action", "x"))
    assert known_action("") is None
