"""`goals` and `echo`: by real processes, in terminals, and here."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial

import anyio
import pytest
from rich.console import Console

from fibaction import (
    ActionClient,
    ActionInfo,
    ConnectionLost,
    GoalID,
    GoalInfo,
    GoalStatus,
    connect,
    serve,
)
from fibaction.cli import observing, watching
from fibaction.cli.ending import ExitCode
from fibaction.cli.goal_list import Row
from fibaction.cli.output import note
from fibaction.cli.watching import echo, goals, picture
from fibaction.events import GoalFeedback
from tests.cli.conftest import Invoke, Open, Robot, Run, Start, detached, interrupt
from tests.cli.served import Heard, Served, counter
from tests.processes import ended, lines_until

ID = GoalID(b"\x01" * 16)
OTHER = GoalID(b"\x02" * 16)


def begun(process: subprocess.Popen[str], fibaction: Run, url: str, name: str) -> None:
    """Wait until a command watches: it tells of a goal then."""
    goal_id = detached(fibaction, url, name, "{seconds: 0.01}")
    lines_until(goal_id, process)


# goals


def test_goals_lists_those_of_all_actions_or_of_one(fibaction: Run, url: str) -> None:
    running = detached(fibaction, url, "wait", "{seconds: 60, steps: 600}")
    over = detached(fibaction, url, "fibonacci", "order: 5")
    everything = fibaction("goals", url=url)
    fibonacci = fibaction("goals", "/fibonacci", url=url)

    assert everything.code == fibonacci.code == 0
    assert everything.lines[0].split() == ["ID", "ACTION", "STATUS", "AGE", "FEEDBACK", "CLIENT"]
    (line,) = (line for line in everything.lines if line.startswith(running))
    assert line.split()[1:3] == ["/wait", "EXECUTING"]
    assert fibonacci.lines[0].split() == ["ID", "STATUS", "AGE", "FEEDBACK", "CLIENT"]
    (line,) = (line for line in fibonacci.lines if line.startswith(over))
    assert line.split()[1] == "SUCCEEDED"
    assert running not in fibonacci.out


def test_goals_as_json_has_all_that_is_known(fibaction: Run, url: str) -> None:
    goal_id = detached(fibaction, url, "arm/pick", "object_name: cup")
    found = fibaction("goals", "arm/pick", "--json", url=url)
    (goal,) = (goal for goal in found.json if goal["goal_id"] == goal_id)

    assert goal.pop("stamp") > 1_700_000_000 * 10**9
    assert goal.pop("client")
    assert goal == {
        "action": "arm/pick",
        "goal_id": goal_id,
        "status": "SUCCEEDED",
        "feedback_count": 4,
    }


@pytest.mark.parametrize("columns", [80, 160])
def test_on_a_terminal_the_list_fits_and_is_colored(
    terminal: Open, fibaction: Run, tcp: str, columns: int
) -> None:
    goal_id = detached(fibaction, tcp, "wait")
    shown = terminal("goals", url=tcp, columns=columns, lines=60)
    assert shown.ends() == 0

    (line,) = (line for line in shown.text.splitlines() if line.startswith(goal_id[:8]))
    assert line.split()[0] == (goal_id if columns == 160 else goal_id[:8])
    assert ":" in line.split()[-1], "the client is not cut off"
    assert b"\x1b[1;32mEXECUTING" in shown.raw.replace(b"\x1b[0m", b"")


@pytest.mark.parametrize("columns", [80, 160])
def test_a_watched_list_is_kept_up_to_date_where_it_is(
    terminal: Open, fibaction: Run, tcp: str, columns: int
) -> None:
    goal_id = detached(fibaction, tcp, "wait", "{seconds: 60, steps: 600}")
    short = goal_id[:8]
    shown = terminal("goals", "wait", "--watch", url=tcp, columns=columns)
    shown.until(rf"^{short}\w* +EXECUTING")
    fibaction("cancel", goal_id, url=tcp)
    screen = shown.until(lambda lines: any(short in one and "CANCELED" in one for one in lines))
    shown.press("\x03")

    assert shown.ends() == 0
    assert sum(short in line for line in screen) == 1
    assert screen[0].startswith("ID ")
    assert shown.text.count("FEEDBACK") == 1
    assert not shown.cursor_hidden


def test_a_watched_list_says_that_the_server_is_away_until_it_is_back(
    terminal: Open, start_robot: Callable[[], Robot]
) -> None:
    robot = start_robot()
    shown = terminal("goals", "--watch", url=robot.tcp)
    shown.until("0 active, 0 ended")
    robot.process.kill()
    shown.until("The server is away: it does not answer")
    shown.press("\x03")

    assert shown.ends() == 0


def test_piped_each_change_is_a_line(started: Start, fibaction: Run, url: str) -> None:
    process = started("goals", "--watch", url=url)
    goal_id = detached(fibaction, url, "wait")
    lines_until(f"{goal_id}  EXECUTING  /wait", process)
    fibaction("cancel", goal_id, url=url)
    lines_until(f"{goal_id}  CANCELED ", process)
    interrupt(process)

    code, _, err = ended(process)
    assert (code, err) == (0, "")


def test_a_server_that_dies_and_one_that_stops_are_told_of(
    started: Start, start_robot: Callable[[], Robot]
) -> None:
    stopped, died = start_robot(), start_robot()
    first = started("goals", "--watch", "--json", url=stopped.unix)
    second = started("echo", "wait", url=f"{died.tcp}?reconnect=false")
    for robot, process in ((stopped, first), (died, second)):
        ready = started("send_goal", "wait", "{seconds: 60}", url=robot.tcp)
        lines_until("EXECUTING", process)
        ready.kill()
    stopped.process.terminate()
    lines_until('"status":"ABORTED"', first)
    stopped.process.wait(30)
    lines_until("/wait is away: its server has stopped", first, errors=True)
    interrupt(first)
    died.process.kill()
    code, _, err = ended(second)

    assert ended(first).code == 0
    assert code == ExitCode.UNREACHABLE
    assert "/wait is away: " in err
    assert err.splitlines()[-1].startswith("Error: ")


# echo


def test_echo_shows_feedback_and_statuses_until_ctrl_c(
    started: Start, fibaction: Run, url: str
) -> None:
    process = started("echo", "wait", url=url)
    begun(process, fibaction, url, "wait")
    goal_id = detached(fibaction, url, "wait", "{seconds: 60, steps: 600}")
    lines = lines_until(f"^Goal {goal_id}: feedback 2$", process)
    fibaction("cancel", goal_id, url=url)
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


def test_echo_as_json_is_an_object_a_line(started: Start, fibaction: Run, url: str) -> None:
    process = started("echo", "/wait", "--json", url=url)
    begun(process, fibaction, url, "wait")
    goal_id = detached(fibaction, url, "wait", "{seconds: 60, steps: 600}")
    lines = lines_until(f'{goal_id}","number":2', process)
    fibaction("cancel", goal_id, url=url)
    process.terminate()
    assert ended(process).code == 0

    events = [event for event in map(json.loads, lines) if event["goal_id"] == goal_id]
    assert [event["event"] for event in events[:3]] == ["status", "status", "feedback"]
    assert [event["status"] for event in events[:2]] == ["ACCEPTED", "EXECUTING"]
    assert events[2] == {
        "event": "feedback",
        "goal_id": goal_id,
        "number": 1,
        "feedback": {"progress": 0.0, "step": "step 0"},
    }


def test_ctrl_c_in_a_terminal_ends_echo(terminal: Open, fibaction: Run, tcp: str) -> None:
    shown = terminal("echo", "stubborn", url=tcp)
    goal_id = detached(fibaction, tcp, "stubborn", "{seconds: 0.5}")
    shown.until(f"Goal {goal_id}: SUCCEEDED")
    shown.press("\x03")

    assert shown.ends() == 0


def test_who_reads_no_more_ends_echo(started: Start, fibaction: Run, tcp: str) -> None:
    process = started("echo", "wait", url=tcp)
    goal_id = detached(fibaction, tcp, "wait", "{seconds: 60, steps: 600}")
    lines_until("feedback", process)
    assert process.stdout is not None
    process.stdout.close()

    assert process.wait(30) == 1
    fibaction("cancel", goal_id, url=tcp)


# In this process


def test_an_action_that_is_not_there_is_one_sentence(invoke: Invoke, tcp: str) -> None:
    for verb in ("goals", "echo"):
        result = invoke(verb, "wiat", url=tcp)
        assert result.exit_code == ExitCode.UNREACHABLE
        assert result.stderr == "Error: nobody serves the action /wiat; did you mean /wait?\n"


def test_nobody_there_is_one_sentence(invoke: Invoke, nobody: str) -> None:
    for verb in (["goals"], ["goals", "-w"], ["echo", "wait"]):
        result = invoke(*verb, url=nobody)
        assert result.exit_code == ExitCode.UNREACHABLE
        assert result.stderr.startswith(f"Error: nobody listens at {nobody}")


def test_the_help_has_examples(invoke: Invoke) -> None:
    assert "  fibaction goals fibonacci --watch\n" in invoke("goals", "-h").output
    assert "  fibaction echo fibonacci --json\n" in invoke("echo", "-h").output


async def running_goals(url: str, name: str | None = None, *, watch: bool = False) -> int:
    with anyio.fail_after(20):
        return await goals(url, name, watch=watch, as_json=False)


@pytest.mark.asyncio
async def test_without_goals_there_is_a_remark(capsys: pytest.CaptureFixture[str]) -> None:
    async with serve(counter("one"), "inproc://watching"):
        assert await running_goals("inproc://watching") == 0
        assert await running_goals("inproc://watching", "one") == 0
        assert await goals("inproc://watching", None, watch=False, as_json=True) == 0

    out, err = capsys.readouterr()
    assert out == ""
    assert err == "There are no goals.\nThere are no goals of /one.\n"


@pytest.mark.asyncio
async def test_a_list_has_a_line_for_each_goal(capsys: pytest.CaptureFixture[str]) -> None:
    server = counter("one")
    async with serve(server, "inproc://watching"):
        await ActionClient(server, server.action).send_goal(1, goal_id=ID)
        assert await running_goals("inproc://watching") == 0
        assert await goals("inproc://watching", "one", watch=False, as_json=True) == 0

    names, line, goal = capsys.readouterr().out.splitlines()
    assert names.startswith("ID ")
    assert line.startswith(f"{ID}  /one    EXECUTING ")
    assert json.loads(goal)["goal_id"] == str(ID)


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Console:
    """A terminal of 80 columns and 10 lines."""
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=10, highlight=False)
    monkeypatch.setattr(watching, "on_terminal", lambda: True)
    monkeypatch.setattr(watching, "console", lambda: console)
    monkeypatch.setattr(watching, "PAUSE", 0.01)
    monkeypatch.setattr(watching, "LOOK", 0.05)
    monkeypatch.setattr(observing, "LOOK", 0.05)
    return console


def drawn(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.asyncio
async def test_on_a_terminal_it_is_colored(screen: Console) -> None:
    server = counter("one")
    async with serve(server, "inproc://watching"):
        await ActionClient(server, server.action).send_goal(1)
        assert await running_goals("inproc://watching") == 0

    assert "\x1b[1;32mEXECUTING\x1b[0m" in drawn(screen)
    assert "\x1b[1mID" in drawn(screen)


@pytest.mark.asyncio
async def test_a_watched_list_lives_through_silence_and_errors(
    screen: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = counter("one")
    served, pictures = Served(server), Heard()

    def record(*arguments: object, **settings: object) -> object:
        text = picture(*arguments, **settings)  # type: ignore[arg-type]  # as they came
        pictures(text.plain)
        return text

    monkeypatch.setattr(watching, "picture", record)
    async with server, anyio.create_task_group() as tasks:
        await ActionClient(server, server.action).send_goal(1)
        tasks.start_soon(watching._watch_screen, served.connection, None)
        await pictures.until(lambda all: "1 active, 0 ended" in all[-1])
        served.silent = True
        await pictures.until(lambda all: "away: it does not answer" in all[-1])
        served.silent, served.error = False, ConnectionLost("the line is dead")
        await pictures.until(lambda all: "away: the line is dead" in all[-1])
        assert "EXECUTING" in pictures[-1]
        served.error = None
        await pictures.until(lambda all: "1 active, 0 ended" in all[-1])
        tasks.cancel_scope.cancel()


@pytest.mark.asyncio
async def test_remarks_that_go_to_a_file_are_not_on_the_screen(
    screen: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors, scope, told = io.StringIO(), anyio.CancelScope(), Heard()
    monkeypatch.setattr(sys, "stderr", errors)

    def remark(*arguments: object, **settings: object) -> object:
        note("a remark")
        if told:
            scope.cancel()
        told("a remark")
        return picture(*arguments, **settings)  # type: ignore[arg-type]  # as they came

    monkeypatch.setattr(watching, "picture", remark)
    server = counter("one")
    async with server:
        with scope:
            await watching._watch_screen(Served(server).connection, None)

    assert "a remark\n" in errors.getvalue()
    assert "0 active" in drawn(screen)
    assert "a remark" not in drawn(screen)


@pytest.mark.asyncio
@pytest.mark.parametrize("name", [None, "one"])
async def test_a_watched_list_ends_with_ctrl_c(screen: Console, name: str | None) -> None:
    codes: list[int] = []

    async def run() -> None:
        codes.append(await running_goals("inproc://watching", name, watch=True))

    async with serve(counter("one"), "inproc://watching"):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run)
            with anyio.fail_after(5):
                while "active" not in drawn(screen):  # noqa: ASYNC110 - a file has no events
                    await anyio.sleep(0.01)
            signal.raise_signal(signal.SIGINT)

    assert codes == [0]


def test_a_picture_has_the_active_goals_first_and_says_what_is_left_out(screen: Console) -> None:
    rows = [
        Row("one", GoalInfo(GoalID(bytes([n] * 16)), n, GoalStatus(4 if n % 2 else 2)))
        for n in range(1, 21)
    ]
    lines = picture(screen, rows, "", actions=True).plain.splitlines()

    assert len(lines) == 9
    assert [line[:2] for line in lines[1:8]] == ["14", "12", "10", "0e", "0c", "0a", "08"]
    assert lines[8] == "10 active, 10 ended; 13 not shown"
    away = picture(screen, [], "gone\x1b", actions=True).plain.splitlines()
    assert away[1] == "The server is away: gone\\x1b"


async def echoed(
    monkeypatch: pytest.MonkeyPatch, verb: Callable[[], object], until: str
) -> list[str]:
    """What a verb says, until it has said that."""
    heard = Heard()
    monkeypatch.setattr(watching, "say", heard)
    monkeypatch.setattr(watching, "say_json", lambda value: heard(json.dumps(value)))
    async with anyio.create_task_group() as tasks:

        async def run() -> None:
            assert await verb() == 0  # type: ignore[misc]  # a verb is async

        tasks.start_soon(run)
        await heard.until(lambda all: any(until in one for one in all))
        signal.raise_signal(signal.SIGINT)
    return heard


@pytest.mark.asyncio
async def test_here_too_each_change_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    server, url = counter("one"), "inproc://watching"
    async with serve(server, url), connect(url, server.action) as client:
        await client.send_goal(1, goal_id=ID)
        watch = partial(goals, url, watch=True)
        plain = await echoed(monkeypatch, partial(watch, None, as_json=False), "EXECUTING")
        events = await echoed(monkeypatch, partial(watch, "one", as_json=True), "EXECUTING")
        words = await echoed(
            monkeypatch, partial(echo, url, "one", full=False, as_json=False), "EXECUTING"
        )
        await client.send_goal(1, goal_id=OTHER)
        await echoed(monkeypatch, partial(echo, url, "one", full=True, as_json=True), "EXECUTING")

    assert plain[0].endswith(f"  {ID}  EXECUTING  /one  1  -")
    assert json.loads(events[0])["status"] == "EXECUTING"
    assert words == [f"Goal {ID}: EXECUTING\n"]


def test_nothing_is_told_twice_and_who_is_away_comes_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watching, "REMEMBERED", 2)
    told = watching._Changes(as_json=False)
    client = Served(counter("one")).connection.client(counter("one").action)
    said = Heard()
    monkeypatch.setattr(watching, "say", said)
    for status in (1, 2, 2, 1, 0, 0):
        told.told("one", GoalInfo(ID, 1, GoalStatus(status)))
    assert [line.split()[2] for line in said] == ["ACCEPTED", "EXECUTING", "ACCEPTED", "forgotten"]
    for number in range(3):
        told.told("one", GoalInfo(GoalID(bytes([number] * 16)), 1, GoalStatus.ACCEPTED))
    assert len(told._statuses) == 2
    told.told("one", GoalFeedback(ID, 1, "not wanted"))
    told.reached([], "")
    told.found(ActionInfo("one"), client)
    told.gone("one", "stopped\x1b")
    told.found(ActionInfo("one"), client)

    assert capsys.readouterr().err == "/one is away: stopped\\x1b\n/one is back\n"


def test_echo_cuts_what_is_long_unless_all_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    said = Heard()
    monkeypatch.setattr(watching, "say", said)
    monkeypatch.setattr(watching, "say_json", said)
    long = GoalFeedback(ID, 3, list(range(1000)))
    for full, as_json in ((False, False), (True, False), (False, True)):
        watching._Echo(as_json, full=full).told("one", long)
    watching._Echo(True, full=False).told("one", GoalInfo(ID, 1, GoalStatus.ACCEPTED))

    assert said[0].startswith(f"Goal {ID}: feedback 3\n    - 0\n")
    assert "... and 872 more" in said[0]
    assert "- 999\n" in said[1]
    assert said[2]["feedback"] == list(range(1000))
    assert said[3]["event"] == "status"
