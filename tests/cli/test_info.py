"""`info`: the servers and the clients of an action, in the output of `ros2 action`."""

from __future__ import annotations

import re

import msgspec
import pytest

from fibaction import Action, __version__, serve
from fibaction._api import ClientConnection
from fibaction.border.abc import Connection
from fibaction.cli.process.exit_codes import Failure
from fibaction.cli.verbs.info import print_info
from fibaction.testing import ScriptedServer
from fibaction.words.goals import ActionPeers
from fibaction.words.intake import Intake, IntakeMode
from tests.cli.conftest import Invoke, Run
from tests.cli.robot import servers


def test_info_has_the_lines_that_ros_prints(here: Run, url: str) -> None:
    code, out, err = here("info", "/fibonacci", "-c", url=url)

    assert (code, err) == (0, "")
    assert re.fullmatch(r"Action: /fibonacci\nAction clients: \d+\nAction servers: \d+\n", out)


def test_info_as_json_has_the_schemas(invoke: Invoke, tcp: str) -> None:
    assert '"goal":{"$ref"' in invoke("info", "wait", "--json", url=tcp).output
    assert (
        '"template":{"seconds":3600.0,"steps":1}'
        in invoke("info", "wait", "--json", url=tcp).output
    )
    assert '"goal"' not in invoke("info", "wait", "--json", "-c", url=tcp).output
    assert invoke("info", "-t", "wait", url=tcp).output.startswith("Action: /wait\n")


def test_of_a_server_that_tells_no_schedule_info_and_list_tell_how_it_takes_goals(
    invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def intakes(*_: object) -> dict[str, Intake]:
        return {"wait": Intake(IntakeMode.HOLD)}

    for verb in ("info", "list"):
        monkeypatch.setattr(f"fibaction.cli.verbs.{verb}.intakes_at", intakes)
    told = invoke("info", "wait", url=tcp).output
    assert "\nIntake: the action is paused\n" in told
    assert "Schedule" not in told
    lines = invoke("list", "--json", url=tcp).output.splitlines()
    [listed] = [one for one in lines if '"wait"' in one]
    assert listed.endswith(',"intake":"hold"}')


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> dict[str, ActionPeers]:
    """The servers and clients of each action, made up by a test."""
    known: dict[str, ActionPeers] = {}

    async def asked(_: Connection, action: str) -> ActionPeers:
        return known.get(action, ActionPeers())

    monkeypatch.setattr(ClientConnection, "peers", asked)
    return known


@pytest.mark.asyncio
async def test_info_names_the_clients_and_the_servers(
    peers: dict[str, ActionPeers], capsys: pytest.CaptureFixture[str]
) -> None:
    peers["wait"] = ActionPeers(servers=("/robot",), clients=("/a", "127.0.0.1:5\x1b"))

    async with serve(servers(), "inproc://info"):
        await print_info("inproc://info", "wait", show_types=True, count=False, as_json=False)

    assert capsys.readouterr().out.splitlines() == [
        "Action: /wait",
        "Action clients: 2",
        "    /a [arm/action/Wait]",
        "    127.0.0.1:5\\x1b [arm/action/Wait]",
        "Action servers: 1",
        "    /robot [arm/action/Wait]",
        f"Version of fibaction: {__version__}",
        "Schedule: all goals run at once",
        "Goal:",
        "    seconds: 3600.0  # a number, optional",
        "    steps: 1  # a whole number, optional",
    ]


@pytest.mark.asyncio
async def test_an_action_that_has_only_clients_is_known(
    peers: dict[str, ActionPeers], capsys: pytest.CaptureFixture[str]
) -> None:
    peers["jump"] = ActionPeers(clients=("/a",))

    await print_info("inproc://empty", "jump", show_types=False, count=False, as_json=False)

    assert "Action clients: 1\n    /a\nAction servers: 0\n" in capsys.readouterr().out


@pytest.mark.asyncio
async def test_an_action_that_has_neither_is_unknown(peers: dict[str, ActionPeers]) -> None:
    with pytest.raises(Failure, match="the action /jump is not served"):
        await print_info("inproc://empty", "jump", show_types=False, count=False, as_json=False)


class Nudge(msgspec.Struct):
    """Nudge the robot.

    Gently.
    """


@pytest.mark.asyncio
async def test_info_shows_the_description(capsys: pytest.CaptureFixture[str]) -> None:
    nudge = Action("nudge", goal=Nudge, feedback=int, result=str)
    async with serve(ScriptedServer(nudge, [""]), "inproc://info"):
        for count in (False, True):
            await print_info("inproc://info", "nudge", show_types=False, count=count, as_json=False)

    head = "Action: /nudge\n    Nudge the robot.\n\n    Gently.\nAction clients:"
    out = capsys.readouterr().out
    assert out.startswith(head)
    assert out.count("Nudge") == 1
