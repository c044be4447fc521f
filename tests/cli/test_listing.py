"""`list`, `info`, `type` and `find`, in the output of `ros2 action`."""

from __future__ import annotations

import re

import pytest

from fibaction import Action, ActionServer, serve
from fibaction._api import ClientConnection
from fibaction.abc import Connection
from fibaction.cli import listing
from fibaction.cli.ending import ExitCode, Failure
from fibaction.goals import ActionPeers
from tests.cli.conftest import Invoke, Run
from tests.cli.robot import servers, words

NAMES = ["/arm/pick", "/fibonacci", "/many", "/stubborn", "/wait", "/words"]


# As processes


def test_list_prints_one_name_a_line(fibaction: Run, url: str) -> None:
    code, out, err = fibaction("list", url=url)

    assert (code, out.splitlines(), err) == (0, NAMES, "")


def test_list_with_types_has_them_in_brackets(fibaction: Run, url: str) -> None:
    assert fibaction("list", "-t", url=url).lines == [
        "/arm/pick [arm/action/Pick]",
        "/fibonacci [arduinobot_msgs/action/Fibonacci]",
        "/many",
        "/stubborn",
        "/wait [arm/action/Wait]",
        "/words",
    ]


def test_type_prints_the_type(fibaction: Run, url: str) -> None:
    code, out, err = fibaction("type", "fibonacci", url=url)

    assert (code, out, err) == (0, "arduinobot_msgs/action/Fibonacci\n", "")


def test_find_prints_the_actions_of_a_type(fibaction: Run, url: str) -> None:
    assert fibaction("find", "arm/action/Wait", url=url).lines == ["/wait"]


def test_info_has_the_lines_that_ros_prints(fibaction: Run, url: str) -> None:
    code, out, err = fibaction("info", "/fibonacci", "-c", url=url)

    assert (code, err) == (0, "")
    assert re.fullmatch(r"Action: /fibonacci\nAction clients: \d+\nAction servers: \d+\n", out)


# In this process


def test_a_count_is_a_number(invoke: Invoke, tcp: str) -> None:
    assert invoke("list", "--count-actions", url=tcp).output == "6\n"
    assert invoke("list", "-c", "--json", url=tcp).output == '{"count":6}\n'
    assert invoke("find", "-c", "arm/action/Wait", url=tcp).output == "1\n"


def test_lists_as_json_have_the_names_that_the_servers_gave(invoke: Invoke, tcp: str) -> None:
    assert invoke("list", "--json", url=tcp).output.splitlines()[:3] == [
        '{"name":"arm/pick","type":"arm/action/Pick"}',
        '{"name":"fibonacci","type":"arduinobot_msgs/action/Fibonacci"}',
        '{"name":"many","type":""}',
    ]
    assert invoke("find", "--json", "arm/action/Wait", url=tcp).output == (
        '{"name":"wait","type":"arm/action/Wait"}\n'
    )


def test_a_type_that_nobody_has_is_found_nowhere_and_that_is_no_error(
    invoke: Invoke, tcp: str
) -> None:
    result = invoke("find", "no/action/Such", url=tcp)

    assert (result.exit_code, result.output) == (0, "")


@pytest.mark.parametrize("verb", ["type", "info"])
def test_a_misspelt_action_suggests_the_near_one(invoke: Invoke, tcp: str, verb: str) -> None:
    result = invoke(verb, "fibonaci", url=tcp)

    assert result.exit_code == ExitCode.UNREACHABLE
    assert result.stdout == ""
    assert result.stderr == (
        "Error: nobody serves the action /fibonaci; did you mean /fibonacci?\n"
    )


def test_a_type_and_the_actions_of_it_are_plain_lines(invoke: Invoke, tcp: str) -> None:
    assert invoke("type", "wait", url=tcp).output == "arm/action/Wait\n"
    assert invoke("find", "arm/action/Wait", url=tcp).output == "/wait\n"


def test_a_type_as_json(invoke: Invoke, tcp: str) -> None:
    assert invoke("type", "/words", "--json", url=tcp).output == '{"name":"words","type":""}\n'


def test_a_server_that_does_not_say_its_type(invoke: Invoke, tcp: str) -> None:
    result = invoke("type", "words", url=tcp)

    assert result.exit_code == ExitCode.ABORTED
    assert result.stderr == "Error: the server of /words does not say its type\n"


def test_info_as_json_has_the_schemas(invoke: Invoke, tcp: str) -> None:
    assert '"goal":{"$ref"' in invoke("info", "wait", "--json", url=tcp).output
    assert '"goal"' not in invoke("info", "wait", "--json", "-c", url=tcp).output
    assert invoke("info", "-t", "wait", url=tcp).output.startswith("Action: /wait\n")


# With peers that this test makes up


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> dict[str, ActionPeers]:
    """Who serves and who uses which action."""
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
        await listing.say_info("inproc://info", "wait", show_types=True, count=False, as_json=False)

    assert capsys.readouterr().out.splitlines() == [
        "Action: /wait",
        "Action clients: 2",
        "    /a [arm/action/Wait]",
        "    127.0.0.1:5\\x1b [arm/action/Wait]",
        "Action servers: 1",
        "    /robot [arm/action/Wait]",
    ]


@pytest.mark.asyncio
async def test_info_counts_without_names(
    peers: dict[str, ActionPeers], capsys: pytest.CaptureFixture[str]
) -> None:
    peers["wait"] = ActionPeers(servers=("/robot",), clients=("/a", "/b"))

    async with serve(servers(), "inproc://info"):
        await listing.say_info(
            "inproc://info", "/wait", show_types=False, count=True, as_json=False
        )

    assert capsys.readouterr().out.splitlines() == [
        "Action: /wait",
        "Action clients: 2",
        "Action servers: 1",
    ]


@pytest.mark.asyncio
async def test_an_action_that_has_only_clients_is_known(
    peers: dict[str, ActionPeers], capsys: pytest.CaptureFixture[str]
) -> None:
    peers["jump"] = ActionPeers(clients=("/a",))

    await listing.say_info("inproc://empty", "jump", show_types=False, count=False, as_json=False)

    assert "Action clients: 1\n    /a\nAction servers: 0\n" in capsys.readouterr().out


@pytest.mark.asyncio
async def test_an_action_that_has_neither_is_unknown(peers: dict[str, ActionPeers]) -> None:
    with pytest.raises(Failure, match="nobody serves the action /jump"):
        await listing.say_info(
            "inproc://empty", "jump", show_types=False, count=False, as_json=False
        )


@pytest.mark.asyncio
async def test_where_nothing_is_served_the_list_is_empty_and_no_name_is_known(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = await listing.list_actions(
        "inproc://empty", show_types=False, count=False, as_json=False
    )

    assert (code, capsys.readouterr().out) == (0, "")
    with pytest.raises(Failure, match="nobody serves the action /jump, nor any other"):
        await listing.say_type("inproc://empty", "jump", as_json=False)


@pytest.mark.asyncio
async def test_names_are_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    mixed = [
        ActionServer(Action(name, goal=str, feedback=int, result=str), words)  # type: ignore[arg-type]  # it never runs
        for name in ("b", "/c", "a")
    ]

    async with serve(mixed, "inproc://order"):
        await listing.list_actions("inproc://order", show_types=True, count=False, as_json=False)

    assert capsys.readouterr().out == "/a\n/b\n/c\n"
