from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Invoke, Run

FILES = Path(__file__).parent.parent / "action_files"
PICK_UP = str(FILES / "robot_msgs" / "action" / "PickUp.action")
COUNT = str(FILES / "plain" / "Count.action")


@pytest.fixture
def expected() -> str:
    return (FILES / "pick_up_types.py").read_text(encoding="utf-8")


def test_a_module_is_written_to_stdout(fibaction: Run, expected: str) -> None:
    done = fibaction("gen", PICK_UP)

    assert (done.code, done.err) == (0, "")
    assert done.out == expected


def test_what_is_written_can_be_imported(fibaction: Run, tmp_path: Path) -> None:
    done = fibaction("gen", PICK_UP, "-o", str(tmp_path / "generated_pick_up.py"))
    assert (done.code, done.out, done.err) == (0, "", "")

    sys.path.insert(0, str(tmp_path))
    try:
        import generated_pick_up  # type: ignore[import-not-found]  # written just now
    finally:
        sys.path.remove(str(tmp_path))
        sys.modules.pop("generated_pick_up", None)

    assert generated_pick_up.PICK_UP.type_name == "robot_msgs/action/PickUp"


def test_a_module_is_written_to_a_file(invoke: Invoke, tmp_path: Path, expected: str) -> None:
    file = tmp_path / "types.py"
    done = invoke("gen", PICK_UP, "--output", str(file))

    assert (done.exit_code, done.output) == (0, "")
    assert file.read_text(encoding="utf-8") == expected


def test_the_name_the_type_and_the_search_path_can_be_given(invoke: Invoke) -> None:
    done = invoke("gen", COUNT, "-n", "arm/tally", "-t", "a/action/Count", "-s", str(FILES))

    assert done.exit_code == 0
    assert 'ARM_TALLY = Action(\n    "arm/tally",' in done.output
    assert 'type_name="a/action/Count"' in done.output


def test_a_malformed_file_is_one_sentence(fibaction: Run, tmp_path: Path) -> None:
    path, file = tmp_path / "Lift.action", tmp_path / "lift.py"
    path.write_text("int32 order\nstring<=0 name\n---\n---\n")
    done = fibaction("gen", str(path), "-o", str(file))

    assert (done.code, done.out) == (2, "")
    assert done.err == (
        f"Error: {path}:2: expected a type like 'int32', 'string<=10', 'float64[3]' or"
        " 'geometry_msgs/Pose', found 'string<=0'\n"
    )
    assert not file.exists()


def test_a_missing_message_is_told_of_with_where_it_was_looked_for(invoke: Invoke) -> None:
    done = invoke("gen", COUNT, env={"AMENT_PREFIX_PATH": None})

    assert done.exit_code == 2
    assert f"{COUNT}:8: expected 'other_msgs/Gripper' on the search path" in done.stderr


def test_a_file_that_is_not_there_is_told_of(invoke: Invoke) -> None:
    done = invoke("gen", "Missing.action")

    assert done.exit_code == 2
    assert done.stderr == "Error: Missing.action: No such file or directory\n"


def test_a_file_that_cannot_be_written_is_told_of(invoke: Invoke, tmp_path: Path) -> None:
    file = tmp_path / "nowhere" / "types.py"
    done = invoke("gen", PICK_UP, "-o", str(file))

    assert done.exit_code == 2
    assert done.stderr == f"Error: {file}: No such file or directory\n"


def test_a_wrong_name_is_told_of(invoke: Invoke) -> None:
    done = invoke("gen", COUNT, "-n", "2 much", "-s", str(FILES))

    assert done.exit_code == 2
    assert done.stderr == "Error: an action's name is like `arm/pick_up`, unlike '2 much'\n"


def test_a_folder_to_search_must_be_there(invoke: Invoke) -> None:
    done = invoke("gen", COUNT, "-s", "nowhere")

    assert done.exit_code == 2
    assert "Directory 'nowhere' does not exist" in done.stderr


def test_the_help_has_an_example(invoke: Invoke) -> None:
    assert "fibaction gen Fibonacci.action > fibonacci_types.py" in invoke("gen", "--help").output
