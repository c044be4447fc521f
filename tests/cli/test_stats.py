"""`stats`: counts, failures and percentiles of actions."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext

import pytest

from fibaction import GoalAborted, ServerNotFound
from fibaction.cli.arguments.names import ROOT
from fibaction.cli.verbs import overview
from fibaction.cli.verbs.overview import lines_of, print_statistics
from fibaction.feeds.statistics import (
    ActionStatistics,
    FailedGoals,
    Percentiles,
    SpanStatistics,
)
from tests.cli.conftest import Invoke
from tests.cli.served import Altered, Served, counter

ENDED = {"SUCCEEDED": 90, "CANCELED": 2, "ABORTED": 8}
RECENT = SpanStatistics(600, 0, 0, dict.fromkeys(ENDED, 0), (), None, None)
TIMES = Percentiles(100, 0.00123, 4.5, 60), Percentiles(100, 12.4, 700, 1000)
WHOLE = SpanStatistics(
    *(86400, 100, 0.0694, ENDED),
    *((FailedGoals("motor is \x1b[2Jhot", 7), FailedGoals("stuck", 1)), *TIMES),
)


def test_statistics_are_two_lines_an_action_and_its_failures_below_them() -> None:
    told = [("drive", ActionStatistics(3, 1, 100, RECENT, WHOLE))]
    heads, *lines = lines_of(told)
    cells = [re.split(" {2,}", line) for line in (heads, *lines)]
    assert cells[1] == [
        *("/drive", "10 min", "0", "0", "0", "0", "0", "-", "-", "-", "-", "1 running, 3 waiting"),
    ]
    assert cells[2] == [
        *("/drive", "24 h", "100", "0.0694", "90", "2", "8", "1.23 ms", "4.5 s", "12 s", "12 min"),
    ]
    assert len(cells[0]) == len(cells[1])
    assert lines[2:] == [
        "",
        "/drive was aborted in 24 h:",
        "  7  motor is \\x1b[2Jhot",
        "  1  stuck",
    ]


@pytest.mark.asyncio
async def test_each_action_is_told_and_one_that_does_not_answer_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def away() -> None:
        raise ServerNotFound("it is away")

    async with counter("pick", [GoalAborted("stuck")]) as pick, counter("place") as place:
        served = Served(pick, Altered(place, status=away))
        monkeypatch.setattr(overview, "connect", lambda _url: nullcontext(served.connection))
        client = served.connection.client(pick.action)
        await (await client.send_goal(1)).outcome()
        assert await print_statistics("", (), ROOT, None, as_json=True) == 0
        printed = capsys.readouterr()
        assert await print_statistics("", ("pick",), ROOT, 0, as_json=False) == 0
        table = capsys.readouterr().out
        assert await print_statistics("", ("place",), ROOT, None, as_json=False) == 6
    value = json.loads(printed.out)
    assert (value["action"], value["past"]) == ("pick", 0)
    assert value["whole"]["failures"] == [{"reason": "stuck", "goals": 1}]
    assert printed.err == "/place is left out: it is away\n"
    assert table.splitlines()[-1] == ("/pick: no history, only the goals that the server remembers")


def test_a_server_without_actions_has_none(invoke: Invoke, tcp: str) -> None:
    answer = invoke("stats", "fibonacci", "--since", "1h", url=tcp)
    assert answer.exit_code == 0
    assert answer.output.startswith("ACTION")
