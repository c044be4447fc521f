"""`pause`, `resume` and `drain`, and how `list` tells of them."""

from __future__ import annotations

import getpass
import json
from collections.abc import AsyncGenerator
from functools import partial

import anyio
import pytest

from fibaction import Action, ActionServer, GoalHandle, connect, serve
from fibaction.cli.arguments.names import ROOT
from fibaction.cli.verbs import levers
from fibaction.cli.verbs.actions import list_actions
from fibaction.cli.verbs.levers import operate, own_name
from fibaction.words.intake import IntakeMode
from tests.cli.conftest import Invoke

pytestmark = pytest.mark.anyio

DRIVE = Action("drive", goal=int, feedback=int, result=str)


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Driver:
    def __init__(self) -> None:
        self.go_on = anyio.Event()
        self.server = ActionServer(DRIVE, self._drive)

    async def _drive(self, goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        yield 1
        await self.go_on.wait()
        yield "there"


async def test_a_pause_is_printed_and_listed_until_the_action_is_resumed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    url = "inproc://paused"
    async with serve(Driver().server, url):
        assert await operate(url, ("drive",), ROOT, IntakeMode.REFUSE, "wet floor") == 0
        printed = capsys.readouterr().out
        assert printed.startswith("/drive: the action is paused since 20")
        assert printed.endswith(f" by {own_name()}: wet floor\n")
        show = partial(list_actions, url, show_types=False, count=False)
        await show(as_json=False)
        listed = capsys.readouterr()
        assert listed.out == "/drive\n"
        assert listed.err == printed
        await show(as_json=True)
        assert json.loads(capsys.readouterr().out)["intake"] == "refuse"
        await show(as_json=False, group=True)
        assert capsys.readouterr().err == printed
        assert await operate(url, (), ROOT, IntakeMode.OPEN) == 0
        assert capsys.readouterr().out == "/drive: takes goals\n"
        await operate(url, (), ROOT, IntakeMode.HOLD, as_json=True)
        value = json.loads(capsys.readouterr().out)
        assert (value["action"], value["mode"]) == ("drive", "hold")
        assert [change["mode"] for change in value["changes"]] == ["hold", "open", "refuse"]


async def test_a_drain_waits_until_no_goal_is_active(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(levers, "GOALS_PAUSE", 0.01)
    url, driver = "inproc://drained", Driver()
    with anyio.fail_after(20):
        async with serve(driver.server, url), connect(url, DRIVE) as client:
            goal = await client.send_goal(1)
            await anext(goal.feedback)
            assert await operate(url, (), ROOT, IntakeMode.DRAIN, wait=0.1) == 5
            assert capsys.readouterr().err == "1 goals are still active\n"
            assert await operate(url, (), ROOT, IntakeMode.DRAIN, worker="a", wait=9) == 1
            assert capsys.readouterr().err.startswith("/drive: action 'drive' has no workers")
            driver.go_on.set()
            assert await operate(url, (), ROOT, IntakeMode.DRAIN, wait=9) == 0
            assert await goal.result() == "there"


async def test_a_drain_does_not_wait_for_a_server_that_does_not_answer(
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Silent:
        async def goals(self) -> None:
            await anyio.sleep_forever()

    silent: object = Silent()
    assert not await levers._ended({"drive": silent}, "", 0.05)  # type: ignore[dict-item]  # it has goals only
    assert capsys.readouterr().err == "the server did not answer\n"


def test_the_verbs_take_names_or_all(invoke: Invoke, tcp: str) -> None:
    for arguments in (
        ("pause", "fibonacci", "--refuse"),
        ("resume", "--all"),
        ("drain", "fibonacci"),
        ("resume", "fibonacci"),
    ):
        assert invoke(*arguments, url=tcp).exit_code == 0


def test_a_user_without_a_name_has_one_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> str:
        raise OSError

    assert own_name().partition("@")[0] == getpass.getuser()
    monkeypatch.setattr(getpass, "getuser", fail)
    assert own_name().startswith("?@")
