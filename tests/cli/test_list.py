"""`list`: the actions that are served, in the output of `ros2 action`."""

from __future__ import annotations

import pytest

from fibaction import Action, ActionServer, serve
from fibaction.cli.list import list_actions
from tests.cli.conftest import Invoke, Run
from tests.cli.robot import words

NAMES = ["/arm/pick", "/fibonacci", "/many", "/stubborn", "/wait", "/words"]


def test_list_prints_one_name_a_line(here: Run, url: str) -> None:
    code, out, err = here("list", url=url)

    assert (code, out.splitlines(), err) == (0, NAMES, "")


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
    assert invoke("list", "--json", url=tcp).output.splitlines()[:3] == [
        '{"name":"arm/pick","type":"arm/action/Pick"}',
        '{"name":"fibonacci","type":"arduinobot_msgs/action/Fibonacci"}',
        '{"name":"many","type":""}',
    ]


@pytest.mark.asyncio
async def test_where_nothing_is_served_the_list_is_empty(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = await list_actions("inproc://empty", show_types=False, count=False, as_json=False)

    assert (code, capsys.readouterr().out) == (0, "")


@pytest.mark.asyncio
async def test_names_are_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    mixed = [
        ActionServer(Action(name, goal=str, feedback=int, result=str), words)  # type: ignore[arg-type]  # it never runs
        for name in ("b", "/c", "a")
    ]

    async with serve(mixed, "inproc://order"):
        await list_actions("inproc://order", show_types=True, count=False, as_json=False)

    assert capsys.readouterr().out == "/a\n/b\n/c\n"
