"""`list`, `find`, `info`, `type` and `workers`: what is served, in the output of `ros2 action`."""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from functools import partial

import msgspec
import pytest

from fibaction import Action, WorkerInfo, __version__, serve
from fibaction._api import ClientConnection
from fibaction.border.abc import Connection, Endpoint
from fibaction.cli.arguments.names import Namespace
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs import actions as module
from fibaction.cli.verbs.actions import (
    lines_of,
    list_actions,
    list_workers,
    note_unreadable,
    print_info,
)
from fibaction.testing import ScriptedServer
from fibaction.words.goals import ActionPeers
from fibaction.words.intake import Intake, IntakeMode
from tests.cli.conftest import Invoke, Run
from tests.cli.robot import servers
from tests.cli.served import counter

NAMES = ["/arm/pick", "/fibonacci", "/many", "/stubborn", "/wait", "/words"]


def test_list_with_types_has_them_in_brackets(here: Run, url: str) -> None:
    assert here("list", "-t", url=url).lines == [
        "/arm/pick [arm/action/Pick]",
        "/fibonacci [arduinobot_msgs/action/Fibonacci]",
        "/many",
        "/stubborn",
        "/wait [arm/action/Wait]",
        "/words",
    ]


def test_a_count_is_a_number(invoke: Invoke, tcp: str) -> None:
    assert invoke("list", "--count-actions", url=tcp).output == "6\n"
    assert invoke("list", "-c", "--json", url=tcp).output == '{"count":6}\n'


def test_lists_as_json_have_the_names_that_the_servers_gave(invoke: Invoke, tcp: str) -> None:
    told = ',"schedule":{"max_goals":20000}}'
    assert invoke("list", "--json", url=tcp).output.splitlines()[:3] == [
        '{"name":"arm/pick","type":"arm/action/Pick"' + told,
        '{"name":"fibonacci","type":"arduinobot_msgs/action/Fibonacci"' + told,
        '{"name":"many","type":""' + told,
    ]


def test_list_limits_itself_to_a_namespace(here: Run, url: str) -> None:
    for namespace in ("/arm", "arm/"):
        assert here("list", "-n", namespace, url=url).lines == ["/arm/pick"]
    assert here("list", "-c", "--namespace", "/arm", url=url).lines == ["1"]
    assert here("list", "-n", "/", url=url).lines == NAMES


@pytest.mark.asyncio
async def test_a_group_is_a_namespace_with_its_actions_below_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = ("robot2/navigate", "/robot1/navigate", "robot2/arm/pick", "look", "robot10/navigate")
    url = "inproc://grouped"
    show = partial(list_actions, url, group=True, show_types=False)

    async with serve(list(map(counter, names)), url):
        await show(count=False, as_json=False)
        grouped = capsys.readouterr().out
        await show(count=True, as_json=False)
        counts = capsys.readouterr().out
        await show(Namespace("/robot2"), count=False, as_json=True)
        values = capsys.readouterr().out
        await show(Namespace("/robot1"), count=True, as_json=True)
        value = capsys.readouterr().out

    assert grouped.splitlines() == [
        *("/", "    look"),
        *("/robot1", "    navigate"),
        *("/robot10", "    navigate"),
        *("/robot2", "    navigate"),
        *("/robot2/arm", "    pick"),
    ]
    assert counts == "/: 1\n/robot1: 1\n/robot10: 1\n/robot2: 1\n/robot2/arm: 1\n"
    assert values.splitlines() == [
        '{"namespace":"/robot2","name":"robot2/navigate","type":""}',
        '{"namespace":"/robot2/arm","name":"robot2/arm/pick","type":""}',
    ]
    assert value == '{"namespace":"/robot1","count":1}\n'


def test_groups_can_have_types(here: Run, tcp: str) -> None:
    assert here("list", "-gt", "-n", "arm", url=tcp).lines == ["/arm", "    pick [arm/action/Pick]"]


def test_find_as_json_has_the_names_that_the_servers_gave(invoke: Invoke, tcp: str) -> None:
    assert invoke("find", "--json", "arm/action/Wait", url=tcp).output == (
        '{"name":"wait","type":"arm/action/Wait"}\n'
    )
    assert invoke("find", "-c", "arm/action/Wait", url=tcp).output == "1\n"
    for name in ("arm/action/Wait", "/arm/action/Wait", "arm/Wait", "Wait"):
        assert invoke("find", name, url=tcp).output == "/wait\n"


def test_an_unknown_type_has_no_actions_and_that_is_not_an_error(invoke: Invoke, tcp: str) -> None:
    result = invoke("find", "no/action/Such", url=tcp)

    assert (result.exit_code, result.output) == (0, "")


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

    monkeypatch.setattr(module, "intakes_at", intakes)
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


def test_a_type_that_the_server_does_not_say(invoke: Invoke, tcp: str) -> None:
    assert invoke("type", "wait", url=tcp).output == "arm/action/Wait\n"
    assert invoke("type", "/words", "--json", url=tcp).output == '{"name":"words","type":""}\n'
    result = invoke("type", "words", url=tcp)

    assert result.exit_code == ExitCode.ABORTED
    assert result.stderr == "Error: the server of /words does not say its type\n"


NOW = 1_800_000_000
WORKERS = [
    WorkerInfo("arm-1", ("pick", "/place"), (NOW - 90) * 10**9, 3, has_room=False, version="1.2.0"),
    WorkerInfo("idle \x1b[2J", (), (NOW - 5) * 10**9),
]


class _Fleet(Connection):
    """A connection to a fleet with some workers."""

    def __init__(self, found: list[WorkerInfo]) -> None:
        self._found = found

    def endpoint(self, action: object) -> Endpoint:
        raise NotImplementedError

    async def actions(self) -> list[object]:  # type: ignore[override]  # not asked for here
        raise NotImplementedError

    async def workers(self) -> list[WorkerInfo]:
        return self._found


def with_workers(monkeypatch: pytest.MonkeyPatch, found: list[WorkerInfo]) -> None:
    @asynccontextmanager
    async def connect(url: str) -> AsyncGenerator[Connection, None]:
        assert url == "nats://broker/robots?token=secret"
        yield _Fleet(found)

    monkeypatch.setattr(module, "connect", connect)


def test_workers_are_told_in_columns() -> None:
    assert lines_of(WORKERS, NOW) == [
        "WORKER        ROOM  GOALS     JOINED  ACTIONS",
        "arm-1         no        3   90 s ago  /pick, /place",
        "idle \\x1b[2J  yes       0  5.0 s ago  -",
    ]


@pytest.mark.asyncio
async def test_workers_as_json_are_one_value_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_workers(monkeypatch, WORKERS[:1])
    await list_workers("nats://broker/robots?token=secret", as_json=True)
    assert capsys.readouterr().out == (
        '{"name":"arm-1","actions":["pick","/place"],"since":1799999910000000000,"goals":3,'
        '"has_room":false,"unreadable":{},"version":"1.2.0"}\n'
    )


@pytest.mark.asyncio
async def test_goals_that_no_worker_can_read_are_counted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counts: list[dict[str, int]] = [{"pick": 3, "place": 1, "drop": 2}, {"pick": 4, "place": 1}]
    actions = ("pick", "place"), ("pick", "place", "drop")
    found = [
        WorkerInfo(str(number), serves, 0, unreadable=unreadable)
        for number, (serves, unreadable) in enumerate(zip(actions, counts, strict=True))
    ]
    found[0] = msgspec.structs.replace(found[0], actions=("pick", "place", "drop"))
    with_workers(monkeypatch, found)
    await list_workers("nats://broker/robots?token=secret", as_json=False)
    rest = "that no worker here can read: start a worker of the version that accepted them, or end"
    assert capsys.readouterr().err.splitlines() == [
        f"3 waiting goals of /pick {rest} them with unreadable='abort'",
        f"1 waiting goal of /place {rest} them with unreadable='abort'",
    ]
    note_unreadable(found, {"place"})
    assert capsys.readouterr().err.startswith("1 waiting goal of /place ")


@pytest.mark.asyncio
async def test_an_empty_fleet_is_a_remark_without_the_settings_of_the_url(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_workers(monkeypatch, [])
    assert await list_workers("nats://broker/robots?token=secret", as_json=False) == 0
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "There are no workers at nats://broker/robots.\n")
