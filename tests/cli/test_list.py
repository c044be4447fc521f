"""`list`: the actions that are served, in the output of `ros2 action`."""

from __future__ import annotations

from functools import partial

import pytest

from fibaction import serve
from fibaction.cli.arguments.namespaces import Namespace
from fibaction.cli.verbs.list import list_actions
from tests.cli.conftest import Invoke, Run
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
