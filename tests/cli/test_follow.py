"""`attach` and `echo`: as processes, in a terminal, and in this process."""

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

from fibaction import ActionInfo, GoalID, GoalInfo, GoalStatus, ProtocolError, connect, serve
from fibaction.border.abc import Endpoint, ForwardingEndpoint, GoalStream
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import follow
from fibaction.cli.verbs.follow import CsvPrinter, EchoPrinter, EventPrinter, attach, echo
from fibaction.client.events import GoalFeedback
from tests.cli.conftest import Run, Start, detached, interrupt
from tests.cli.served import Heard, Served, counter
from tests.support.processes import ended, lines_until

ID = GoalID(b"\x01" * 16)
OTHER = GoalID(b"\x02" * 16)


def test_attach_shows_what_comes_and_ends_as_the_goal_does(
    started: Start, here: Run, tcp: str
) -> None:
    goal_id = detached(here, tcp, "wait", "{seconds: 60, steps: 600}")
    process = started("attach", goal_id[:8], url=tcp)
    lines = lines_until("step: step", process)
    here("cancel", goal_id, url=tcp)
    code, out, err = ended(process)

    assert (code, err) == (ExitCode.CANCELED, "")
    assert lines[0] == f"Goal accepted with ID: {goal_id}\n"
    assert out.endswith("Goal finished with status: CANCELED (asked to stop)\n")


def test_attach_to_a_goal_that_has_ended_gives_its_result(here: Run, url: str) -> None:
    goal_id = detached(here, url, "arm/pick", "object_name: cup")
    done = here("attach", goal_id, "arm/pick", "--json", url=url)

    assert (done.code, done.err) == (0, "")
    assert done.json[0]["goal_id"] == goal_id
    assert done.json[-1]["status"] == "SUCCEEDED"
    assert done.json[-1]["result"]["goal"]["object_name"] == "cup"


class GivenUp(ForwardingEndpoint):
    """A server that has given up each goal, with this checkpoint."""

    def __init__(self, inner: Endpoint, checkpoint: bytes) -> None:
        super().__init__(inner)
        self._checkpoint = checkpoint

    async def feedback(self, *arguments: Any, **more: Any) -> GoalStream:
        stream: Any = await super().feedback(*arguments, **more)
        stream.checkpoint = self._checkpoint
        return cast("GoalStream", stream)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("checkpoint", "value", "text"),
    [
        (b"\x04", 4, "given it up, and can run it again from its checkpoint:\n    4\n\n"),
        (b"", None, "given it up, and can run it again from its beginning.\n"),
    ],
)
async def test_the_checkpoint_of_a_goal_that_was_given_up_is_shown(
    checkpoint: bytes, value: int | None, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    url = "inproc://given-up"
    server = counter("one", ["done"])
    async with serve(GivenUp(server, checkpoint), url), connect(url, server.action) as client:
        async with client.send_goal(1) as goal:
            await goal.result()
        await attach(url, str(goal.goal_id), None, full=True, as_json=False)
        assert capsys.readouterr().out.endswith(text)
        await attach(url, str(goal.goal_id), None, full=False, as_json=True)
        last = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert last == {"event": "given_up", "checkpoint": value}


@pytest.mark.asyncio
@pytest.mark.parametrize("checkpoint", [b"\xc1", b"\x91" * 5000, b"\x81\x80\x01"])
async def test_a_checkpoint_that_cannot_be_read_is_one_sentence(checkpoint: bytes) -> None:
    url = "inproc://unreadable-checkpoint"
    server = counter("one", ["done"])
    async with serve(GivenUp(server, checkpoint), url), connect(url, server.action) as client:
        async with client.send_goal(1) as goal:
            await goal.result()
        with pytest.raises(ProtocolError, match=f"the checkpoint of goal {goal.goal_id} is not"):
            await attach(url, str(goal.goal_id), None, full=True, as_json=False)


@pytest.mark.asyncio
async def test_ctrl_c_leaves_the_goal_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    server, url = counter("one", [11, anyio.Event()]), "inproc://attach"
    codes: list[int] = []
    followed = anyio.Event()

    async def follow(*arguments: object, **settings: object) -> GoalStream:
        stream = await feedback(*arguments, **settings)  # type: ignore[arg-type]  # as they came
        followed.set()
        return stream

    async def run() -> None:
        codes.append(await attach(url, "01", None, full=False, as_json=True))

    feedback, server.feedback = server.feedback, follow  # type: ignore[method-assign, assignment]  # to know when
    async with serve(server, url), connect(url, server.action) as client:
        goal = await client.send_goal(1, goal_id=ID)
        with anyio.fail_after(10):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(run)
                await followed.wait()
                signal.raise_signal(signal.SIGINT)
        assert goal.status.is_active

    assert codes == [ExitCode.INTERRUPTED]
    out, err = capsys.readouterr()
    assert err == f"The goal {ID} was left as it is.\n"
    assert json.loads(out.splitlines()[0])["event"] == "accepted"


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
    monkeypatch.setattr(follow, "REMEMBERED", 2)
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
    monkeypatch.setattr(follow, "on_terminal", lambda: True)
    monkeypatch.setattr(follow, "REMEMBERED", 2)
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
