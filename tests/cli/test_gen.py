from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from fibaction import ActionInfo, ConnectionLost, TransportError
from fibaction.border.abc import Connection, Endpoint
from fibaction.cli.verbs import gen
from tests.cli.conftest import Invoke, Run

FILES = Path(__file__).parent.parent / "action_files"
PICK_UP = str(FILES / "robot_msgs" / "action" / "PickUp.action")


@pytest.fixture
def expected() -> str:
    return (FILES / "pick_up_types.py").read_text(encoding="utf-8")


def test_a_module_is_written_to_a_file(invoke: Invoke, tmp_path: Path, expected: str) -> None:
    file = tmp_path / "types.py"
    done = invoke("gen", PICK_UP, "--output", str(file))

    assert (done.exit_code, done.output) == (0, "")
    assert file.read_text(encoding="utf-8") == expected


def test_messages_and_services_are_written_by_name_and_by_file(
    invoke: Invoke, tmp_path: Path
) -> None:
    done = invoke("gen", "geometry_msgs/msg/Twist", "std_srvs/srv/SetBool")
    assert (done.exit_code, done.output) == (0, (FILES / "drive_types.py").read_text("utf-8"))
    file = tmp_path / "my_msgs/srv/Ask.srv"
    file.parent.mkdir(parents=True)
    file.write_text("geometry_msgs/Point at\n---\n")
    done = invoke("gen", str(file))
    assert 'ASK = Service(\n    "my_msgs/srv/Ask",' in done.output


def test_the_name_the_type_and_the_search_path_can_be_given(invoke: Invoke) -> None:
    done = invoke(
        "gen",
        str(FILES / "plain" / "Count.action"),
        "-n",
        "arm/tally",
        "-t",
        "a/action/Count",
        "-s",
        str(FILES),
    )

    assert done.exit_code == 0
    assert 'ARM_TALLY = Action(\n    "arm/tally",' in done.output
    assert 'type_name="a/action/Count"' in done.output


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


def test_a_server_without_actions_has_no_types(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gen, "import_servers", lambda target: [])
    done = invoke("gen", "--ts", "robot:server")

    assert done.exit_code == 2
    assert done.stderr == "Error: robot:server serves no actions, so there are no types\n"


# Of a robot

PICK, PLACE = "arm_msgs/action/Pick", "arm_msgs/action/Place"
ROBOT = "dds://?domain_id=3"


class _Robot(Connection):
    """A connection to a robot whose types are these texts, or these errors."""

    def __init__(self, actions: dict[str, dict[str, str] | TransportError]) -> None:
        self._actions = actions

    def endpoint(self, action: object) -> Endpoint:
        raise NotImplementedError

    async def actions(self) -> list[ActionInfo]:
        return [ActionInfo(name, f"arm_msgs/action/{name.title()}") for name in self._actions]

    async def interface_texts(self, action: ActionInfo) -> dict[str, str]:
        texts = self._actions[action.name]
        if isinstance(texts, TransportError):
            raise texts
        return texts


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, str] | TransportError]:
    """The actions of the robot at `ROBOT`."""
    found: dict[str, dict[str, str] | TransportError] = {
        "pick": {PICK: "int32 x\n---\n---\n"},
        "place": {PLACE: "int32 y\n---\n---\n"},
    }

    @asynccontextmanager
    async def connect(url: str) -> AsyncGenerator[Connection, None]:
        assert url == ROBOT
        yield _Robot(found)

    monkeypatch.setattr(gen, "connect", connect)
    return found


@pytest.mark.usefixtures("served")
def test_all_actions_of_a_robot_are_one_module(invoke: Invoke, tmp_path: Path) -> None:
    done = invoke("-u", ROBOT, "gen", "--from-robot")
    assert (done.exit_code, done.stderr) == (0, "")
    assert "PICK = Action(" in done.stdout
    assert "PLACE = Action(" in done.stdout
    path = tmp_path / "robot.py"
    assert invoke("gen", "--from-robot", "-u", ROBOT, "-o", str(path)).output == ""
    assert path.read_text(encoding="utf-8") == done.stdout


@pytest.mark.usefixtures("served")
def test_actions_of_a_robot_can_be_named(invoke: Invoke) -> None:
    done = invoke("-u", ROBOT, "gen", "--from-robot", "/place", "place")
    assert done.stdout.count("Action(\n") == 1
    assert "PLACE = Action(" in done.stdout
    done = invoke("-u", ROBOT, "gen", "--from-robot", "plaice")
    assert done.exit_code == 6
    assert done.stderr == "Error: the action /plaice is not served; did you mean /place?\n"


def test_what_cannot_be_written_is_said_and_the_rest_is_written(
    invoke: Invoke, served: dict[str, dict[str, str] | TransportError], tmp_path: Path
) -> None:
    served["push"] = TransportError("its type is not known: ask for it")
    served["pull"] = {"arm_msgs/action/Pull": "int33 x\n---\n---\n"}
    done = invoke("-u", ROBOT, "gen", "--from-robot")
    assert done.exit_code == 0
    push, pull = done.stderr.splitlines()
    assert push == "/push is not written: its type is not known: ask for it"
    assert pull.startswith("/pull is not written: arm_msgs/action/Pull.action:1: expected a type")
    assert pull.endswith("; write it alone, with --from-robot /pull")
    assert "PICK = Action(" in done.stdout

    path = tmp_path / "robot.py"
    done = invoke("-u", ROBOT, "gen", "--from-robot", "pick", "push", "-o", str(path))
    assert done.exit_code == 2
    assert done.stderr.splitlines() == [
        push,
        "Error: nothing is written, because types are not known",
    ]
    assert not path.exists()


def test_a_robot_of_which_nothing_can_be_written_is_an_error(
    invoke: Invoke, served: dict[str, dict[str, str] | TransportError]
) -> None:
    served.clear()
    done = invoke("-u", ROBOT, "gen", "--from-robot")
    assert (done.exit_code, done.stderr) == (6, "Error: dds:// serves no actions\n")
    served["push"] = TransportError("its type is not known: ask for it")
    assert invoke("-u", ROBOT, "gen", "--from-robot").exit_code == 2
    served["push"] = ConnectionLost("the line is cut")
    done = invoke("-u", ROBOT, "gen", "--from-robot")
    assert (done.exit_code, done.stderr) == (6, "Error: the line is cut\n")


def test_a_server_without_types_of_ros_is_told_where_to_ask(invoke: Invoke, tcp: str) -> None:
    done = invoke("-u", tcp, "gen", "--from-robot", "fibonacci")
    assert done.exit_code == 2
    assert "the types of 'fibonacci' are known here as JSON Schemas only: connect" in done.stderr
