"""`echo`: as processes, in a terminal, and in this process."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import anyio
import pytest

from fibaction import ActionInfo, GoalID, GoalInfo, GoalStatus, connect, serve
from fibaction.cli.verbs import echo as echo_module
from fibaction.cli.verbs.echo import CsvPrinter, EchoPrinter, EventPrinter, echo
from fibaction.client.events import GoalFeedback
from tests.cli.conftest import Run, Start, detached, interrupt
from tests.cli.served import Heard, Served, counter
from tests.support.processes import ended, lines_until

ID = GoalID(b"\x01" * 16)
OTHER = GoalID(b"\x02" * 16)


def begun(process: subprocess.Popen[str], fibaction: Run, url: str, name: str) -> None:
    """Wait until a command follows: it prints a goal then."""
    goal_id = detached(fibaction, url, name, "{seconds: 0.01}")
    lines_until(goal_id, process)


def test_echo_shows_feedback_and_statuses_until_ctrl_c(started: Start, here: Run, tcp: str) -> None:
    process = started("echo", "wait", url=tcp)
    begun(process, here, tcp, "wait")
    goal_id = detached(here, tcp, "wait", "{seconds: 60, steps: 600}")
    lines = lines_until(f"^Goal {goal_id}: feedback 2$", process)
    here("cancel", goal_id, url=tcp)
    lines += lines_until(f"^Goal {goal_id}: CANCELED", process)
    interrupt(process)
    code, _, err = ended(process)

    assert (code, err) == (0, "")
    story = [line for line in "".join(lines).splitlines() if goal_id in line]
    assert story[:2] == [f"Goal {goal_id}: ACCEPTED", f"Goal {goal_id}: EXECUTING"]
    assert story[2] == f"Goal {goal_id}: feedback 1"
    assert f"Goal {goal_id}: CANCELING" in story
    assert story[-1] == f"Goal {goal_id}: CANCELED"
    first = lines.index(f"Goal {goal_id}: feedback 1\n")
    assert lines[first + 1 : first + 4] == ["    progress: 0.0\n", "    step: step 0\n", "\n"]


async def echoed(verb: Callable[[], object], until: str) -> list[str]:
    """What a verb prints, until it has printed that."""
    heard = Heard()
    with heard.on_stdout():
        async with anyio.create_task_group() as tasks:

            async def run() -> None:
                assert await verb() == 0  # type: ignore[misc]  # a verb is async

            tasks.start_soon(run)
            await heard.until(lambda all: any(until in one for one in all))
            signal.raise_signal(signal.SIGINT)
    return heard


@pytest.mark.asyncio
async def test_each_change_is_printed() -> None:
    server, url = counter("one"), "inproc://echo"
    async with serve(server, url), connect(url, server.action) as client:
        await client.send_goal(1, goal_id=ID)
        words = await echoed(partial(echo, url, "one", EchoPrinter(False, full=False)), "EXECUTING")
        await client.send_goal(1, goal_id=OTHER)
        await echoed(partial(echo, url, "one", EchoPrinter(True, full=True)), "EXECUTING")

    assert words == [f"Goal {ID}: EXECUTING\n"]


def test_nothing_is_printed_twice_and_an_action_that_was_away_comes_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(echo_module, "REMEMBERED", 2)
    printer = EventPrinter(as_json=False)
    client = Served(counter("one")).connection.client(counter("one").action)
    for status in (1, 2, 2, 1, 0, 0):
        printer.on_event("one", GoalInfo(ID, 1, GoalStatus(status)))
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in said] == ["ACCEPTED", "EXECUTING", "ACCEPTED", "forgotten"]
    for number in range(3):
        printer.on_event("one", GoalInfo(GoalID(bytes([number] * 16)), 1, GoalStatus.ACCEPTED))
    assert len(printer._statuses) == 2
    printer.on_event("one", GoalFeedback(ID, 1, "not wanted"))
    printer.on_actions([], "")
    printer.on_action_found(ActionInfo("one"), client)
    printer.on_action_lost("one", "stopped\x1b")
    printer.on_action_found(ActionInfo("one"), client)

    assert capsys.readouterr().err == "/one is away: stopped\\x1b\n/one is back\n"


def test_echo_in_a_terminal_has_a_bar_where_feedback_tells_the_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(echo_module, "on_terminal", lambda: True)
    monkeypatch.setattr(echo_module, "REMEMBERED", 2)
    said, printer = Heard(), EchoPrinter(False, full=False)
    with said.on_stdout():
        for number, feedback in ((1, {"progress": 50.0}), (2, {"progress": 1.0}), (3, {"n": 1})):
            printer.on_event("one", GoalFeedback(ID, number, feedback))
        for byte in (2, 3):
            other = GoalID(bytes([byte] * 16))
            printer.on_event("one", GoalFeedback(other, 1, {"progress": 1.0}))
        printer.on_event("one", GoalFeedback(ID, 4, {"progress": 1.0}))
        EchoPrinter(False, full=True).on_event("one", GoalFeedback(ID, 5, {"progress": 1.0}))

    heads = [one.split(": ", 1)[1].splitlines()[0] for one in said]
    assert [head.split()[1] for head in heads] == ["1", "2", "3", "1", "1", "4", "5"]
    told = [head.split()[-1] for head in heads]
    assert told[:3] == ["50%", "1%", "3"], "each goal has a meter: 1 is one of 100 here"
    assert told[3:] == ["100%", "100%", "100%", "5"], "and the oldest was forgotten"
    assert "    progress: 50.0\n" in said[0]


def test_echo_cuts_what_is_long_unless_all_is_wanted() -> None:
    said = Heard()
    long = GoalFeedback(ID, 3, list(range(1000)), at=7)
    with said.on_stdout():
        for full, as_json in ((False, False), (True, False), (False, True)):
            EchoPrinter(as_json, full=full).on_event("one", long)
        EchoPrinter(True, full=False).on_event("one", GoalInfo(ID, 1, GoalStatus.ACCEPTED))

    assert said[0].startswith(f"Goal {ID}: feedback 3\n    - 0\n")
    assert "... and 872 more" in said[0]
    assert "- 999\n" in said[1]
    assert json.loads(said[2]) == {
        "event": "feedback",
        "goal_id": str(ID),
        "number": 3,
        "at": 7,
        "feedback": list(range(1000)),
    }
    assert json.loads(said[3])["event"] == "status"


def test_csv_has_a_row_for_each_feedback_with_its_time_and_its_fields() -> None:
    said = Heard()
    fields = {"name": {"type": "string"}, "=x": {"type": "number"}, "gone": {"type": "string"}}
    described = ActionInfo("one", "", {}, {"type": "object", "properties": fields}, {})
    plain = ActionInfo("one", "", {}, {"type": "integer"}, {})
    at = 1_700_000_000_123_456_789
    with said.on_stdout():
        printer = CsvPrinter()
        for _ in range(2):  # its server has started again
            printer.on_action_found(described, client=cast("Any", None))
        printer.on_event("one", GoalInfo(ID, 1, GoalStatus.ACCEPTED))
        feedback = {"name": "-a\n", "=x": [1, 2.5], "gone": None}
        printer.on_event("one", GoalFeedback(ID, 3, feedback, 2, at))
        printer.on_event("one", GoalFeedback(ID, 4, "odd", 2, at))
        printer = CsvPrinter()
        printer.on_action_found(plain, client=cast("Any", None))
        printer.on_event("one", GoalFeedback(ID, 1, 7, 1, at))

    when = "2023-11-14T22:13:20.123456Z"
    assert list(csv.reader(said)) == [
        ["time", "goal_id", "attempt", "number", "name", "'=x", "gone"],
        [when, str(ID), "2", "3", "'-a\\x0a", "[1,2.5]", ""],
        [when, str(ID), "2", "4", "", "", ""],
        ["time", "goal_id", "attempt", "number", "feedback"],
        [when, str(ID), "1", "1", "7"],
    ]
