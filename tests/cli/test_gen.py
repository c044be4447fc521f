from __future__ import annotations

from pathlib import Path

import pytest

from fibaction.cli.verbs import gen
from tests.cli.conftest import Invoke, Run

FILES = Path(__file__).parent.parent / "action_files"
PICK_UP = str(FILES / "robot_msgs" / "action" / "PickUp.action")
COUNT = str(FILES / "plain" / "Count.action")


@pytest.fixture
def expected() -> str:
    return (FILES / "pick_up_types.py").read_text(encoding="utf-8")


def test_a_module_is_written_to_stdout(here: Run, expected: str) -> None:
    done = here("gen", PICK_UP)

    assert (done.code, done.err) == (0, "")
    assert done.out == expected


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


def test_a_malformed_file_is_one_sentence_and_writes_nothing(
    fibaction: Run, tmp_path: Path
) -> None:
    path, file = tmp_path / "Lift.action", tmp_path / "lift.py"
    path.write_text("int32 order\nstring<=0 name\n---\n---\n")
    done = fibaction("gen", str(path), "-o", str(file))

    assert (done.code, done.out) == (2, "")
    assert done.err == (
        f"Error: {path}:2: expected a type like 'int32', 'string<=10', 'float64[3]' or"
        " 'geometry_msgs/Pose', found 'string<=0'\n"
    )
    assert not file.exists()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ([COUNT], f"{COUNT}:8: expected 'other_msgs/Gripper' on the search path"),
        (["Missing.action"], "Missing.action: No such file or directory\n"),
        ([PICK_UP, "-o", "/nowhere/types.py"], "/nowhere/types.py: No such file or directory\n"),
        ([COUNT, "-n", "2 much", "-s", str(FILES)], "an action's name is like `arm/pick_up`"),
        ([COUNT, "-s", "nowhere"], "Directory 'nowhere' does not exist"),
    ],
)
def test_an_error_is_one_of_usage_and_says_what_is_wrong(
    arguments: list[str], error: str, invoke: Invoke
) -> None:
    done = invoke("gen", *arguments, env={"AMENT_PREFIX_PATH": None})

    assert done.exit_code == 2
    assert error in done.stderr


def test_the_help_has_an_example(invoke: Invoke) -> None:
    assert "fibaction gen Fibonacci.action > fibonacci_types.py" in invoke("gen", "--help").output


def test_typescript_is_written_of_a_file_a_module_and_a_server(
    fibaction: Run, invoke: Invoke, tcp: str, tmp_path: Path, folder: Path
) -> None:
    of_file = invoke("gen", "--ts", PICK_UP, "-n", "arm/pick")
    assert '"arm/pick": ArmPickAction;' in of_file.output
    of_module = fibaction("gen", "--ts", "robot:server")
    assert (of_module.code, '"count": CountAction;' in of_module.out) == (0, True)
    path = tmp_path / "robot.ts"
    of_server = invoke("gen", "--ts", tcp, "-o", str(path))
    assert (of_server.exit_code, of_server.output) == (0, "")
    assert '"fibonacci": FibonacciAction;' in path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["no.action"], "no.action: No such file or directory"),
        (["no:server"], "there is no module 'no' in "),
        (["tcp://127.0.0.1:1"], "no server listens at tcp://127.0.0.1:1 "),
        (["robot:server", "-n", "a"], "--name, --type and --search are for .action files"),
        (["tests.cli.robot:servers", "-o", "/nowhere/x.ts"], "/nowhere/x.ts: No such file"),
    ],
)
def test_typescript_that_cannot_be_written_is_one_sentence(
    invoke: Invoke, arguments: list[str], error: str
) -> None:
    done = invoke("gen", "--ts", *arguments)

    assert done.exit_code in (2, 6)
    assert done.stderr.startswith(f"Error: {error}")


def test_without_a_server_another_url_is_advised_and_no_option(invoke: Invoke, nobody: str) -> None:
    done = invoke("gen", "--ts", nobody)

    assert done.stderr.startswith(f"Error: no server listens at {nobody} ")
    assert done.stderr.endswith(": start the server, or give another URL\n")


def test_a_server_without_actions_has_no_types(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gen, "import_servers", lambda target: [])
    done = invoke("gen", "--ts", "robot:server")

    assert done.exit_code == 2
    assert done.stderr == "Error: robot:server serves no actions, so there are no types\n"
