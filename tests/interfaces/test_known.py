"""The interface files that a program has loaded."""

from __future__ import annotations

from pathlib import Path

import pytest

from fibaction.action_files import InterfaceError, load_action
from fibaction.interfaces.files import (
    define_action,
    define_types,
    known_action,
    read_interface,
    read_message,
    read_service,
)
from fibaction.interfaces.packages import SearchPath
from fibaction.interfaces.source import types_source
from tests.support.interface_files import write


def load(path: Path, field: str) -> None:
    load_action(write(path, f"int32 {field}\n---\n---\n"))


def test_a_file_that_was_loaded_is_known_by_its_type(tmp_path: Path) -> None:
    for folder, field in (("one", "x"), ("two", "y")):
        load(tmp_path / folder / "known_msgs/action/Go.action", field)
    found = known_action("known_msgs/action/Go")
    assert found is not None
    assert [one.name for one in found.goal.definition.fields] == ["y"]


def test_a_file_without_a_package_is_not_known(tmp_path: Path) -> None:
    load(tmp_path / "Lost.action", "x")
    assert known_action("") is None


def test_a_type_that_was_defined_is_known_until_another_file_of_it_is_loaded(
    tmp_path: Path,
) -> None:
    type_name = "defined_msgs/action/Go"
    texts = {type_name: "Part part\n---\n---\n", "defined_msgs/msg/Part": "int32 z\n"}
    for _ in range(2):
        define_action(type_name, texts)
        found = known_action(type_name)
        assert found is not None
        assert found is known_action(type_name)
        assert found.goal.nested["part"].definition.fields[0].name == "z"
        define_action(type_name, {})
        load(tmp_path / f"{type_name}.action", "x")
        found = known_action(type_name)
        assert found is not None
        assert found.goal.definition.fields[0].name == "x"


def test_texts_that_do_not_define_a_type_are_an_error_whenever_it_is_used() -> None:
    define_action("broken_msgs/action/Go", {"broken_msgs/action/Go": "int33 x\n---\n---\n"})
    for _ in range(2):
        with pytest.raises(InterfaceError, match=r"broken_msgs/action/Go\.action:1: expected"):
            known_action("broken_msgs/action/Go")


NOWHERE = SearchPath((), ())


def test_messages_and_services_that_were_defined_need_no_files() -> None:
    define_types(
        {
            "told_msgs/msg/Part": "int32 z\n",
            "told_msgs/msg/Whole": "Part part\n",
            "told_msgs/srv/Ask": "Part part\n---\nWhole whole\n",
        }
    )
    whole = read_message("told_msgs/msg/Whole", NOWHERE)
    assert whole.nested["part"].definition.fields[0].name == "z"
    ask = read_service("told_msgs/srv/Ask", NOWHERE)
    assert (ask.type_name, ask.response.nested["whole"].type_name) == (
        "told_msgs/srv/Ask",
        "told_msgs/msg/Whole",
    )


def test_types_of_one_name_are_not_written_to_one_module(tmp_path: Path) -> None:
    paths = [tmp_path / package / "msg/Part.msg" for package in ("one_msgs", "two_msgs")]
    files = [read_interface(write(path, "int32 z\n"), []) for path in paths]
    with pytest.raises(ValueError, match="two_msgs/msg/Part has the name of another message"):
        types_source(files)


@pytest.mark.parametrize("lost", ["Part.msg", "9/Part.msg"])
def test_a_file_outside_of_a_package_has_no_type(tmp_path: Path, lost: str) -> None:
    with pytest.raises(InterfaceError, match=r"expected a file such as my_msgs/msg/Name"):
        read_interface(write(tmp_path / lost, "int32 z\n"), [])
