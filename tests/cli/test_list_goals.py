"""`goals`: as processes, in terminals, and in this process."""

from __future__ import annotations

import csv
import io
import json
import signal
from collections.abc import AsyncGenerator, Callable
from functools import partial
from typing import Any

import anyio
import pytest
from rich.console import Console

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ConnectionLost,
    GoalHandle,
    GoalID,
    GoalInfo,
    GoalStatus,
    connect,
    serve,
)
from fibaction.cli.arguments.goal_lookup import GoalChoice
from fibaction.cli.arguments.names import Namespace
from fibaction.cli.output.goal_details import MOST_ENDS, Outcomes
from fibaction.cli.output.goal_table import GoalRow, picture
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import list_goals
from fibaction.cli.verbs.list_goals import Form
from fibaction.observe.monitor import AnyClient
from tests.cli.conftest import Open, Robot, Run, Start, detached, interrupt
from tests.cli.served import Altered, Heard, Served, counter
from tests.cli.test_follow import echoed
from tests.support.processes import ended, lines_until
from tests.support.virtual_time import in_virtual_time

ID = GoalID(b"\x01" * 16)


@pytest.fixture(scope="module")
def robot(start_robot: Callable[[], Robot]) -> Robot:
    """A server process without goals of other files."""
    return start_robot()


def test_goals_lists_those_of_all_actions_or_of_one(here: Run, url: str) -> None:
    running = detached(here, url, "wait", "{seconds: 60, steps: 600}")
    over = detached(here, url, "fibonacci", "order: 5")
    everything = here("goals", url=url)
    fibonacci = here("goals", "/fibonacci", url=url)

    assert everything.code == fibonacci.code == 0
    heads = ["ID", "ACTION", "STATUS", "AGE", "FEEDBACK", "CLIENT", "REASON,", "RESULT"]
    assert everything.lines[0].split() == heads
    (line,) = (line for line in everything.lines if line.startswith(running))
    assert line.split()[1:3] == ["/wait", "EXECUTING"]
    assert fibonacci.lines[0].split() == [heads[0], *heads[2:]]
    (line,) = (line for line in fibonacci.lines if line.startswith(over))
    assert line.split()[1] == "SUCCEEDED"
    assert line.endswith("  sequence: [0, 1, 1, 2, 3, 5]")
    assert running not in fibonacci.out


def row(number: int, status: GoalStatus) -> GoalRow:
    return GoalRow("count", GoalInfo(GoalID(bytes([number] * 16)), number, status))


def test_active_goals_and_then_the_newest_are_chosen_and_stay_in_their_order() -> None:
    statuses = [GoalStatus.EXECUTING, GoalStatus.ABORTED, GoalStatus.SUCCEEDED, GoalStatus.ACCEPTED]
    rows = [row(number, status) for number, status in enumerate(statuses)]
    assert GoalChoice(limit=3).of(rows) == ([rows[0], rows[2], rows[3]], 1)
    assert GoalChoice(limit=4).of(rows) == (rows, 0)
    assert GoalChoice().of(rows) == (rows, 0)


def test_goals_are_found_by_what_they_are(here: Run, url: str) -> None:
    running = detached(here, url, "wait", "{seconds: 60, steps: 600}")
    labels = ("--label", "order=17", "--label", "note=by hand")
    count = detached(here, url, "fibonacci", "order: 1", *labels)
    other = detached(here, url, "fibonacci", "order: 1", "--label", "order=18")
    pick = detached(here, url, "arm/pick", "object_name: cup")
    mine = (running, count, other, pick)

    def listed(*options: str) -> list[dict[str, Any]]:
        goals = here("goals", *options, "--limit", "0", "--json", url=url).json
        return [goal for goal in goals if goal["goal_id"] in mine]

    def found(*options: str) -> list[str]:
        return [goal["goal_id"] for goal in listed(*options)]

    assert found() == [*mine]
    assert found("--status", "ACTIVE") == [running]
    assert found("--status", "succeeded", "--status", "aborted") == [count, other, pick]
    assert found("--search", f"PICK {pick[:12].upper()}") == [pick]
    assert found("--search", f"pick {count}") == []
    assert found("--search", "succeeded", "--sort", "action") == [pick, count, other]
    assert found("fibonacci", "--label", "order=17") == [count]
    assert found("--label", "order=17", "--label", "note=by hand") == [count]
    assert found("--label", "order=18", "--label", "note=by hand") == []
    [goal] = listed("--label", "note=by hand")
    assert goal["labels"] == {"order": "17", "note": "by hand"}
    heading, *_, cells = csv.reader(here("goals", "--label", "order=18", "--csv", url=url).lines)
    assert dict(zip(heading, cells, strict=True))["labels"] == '{"order":"18"}'
    both = ("fibonacci", "arm/pick")
    assert found(*both, "--since", str(goal["stamp"] + 1)) == [other, pick]
    assert found(*both, "--until", str(goal["stamp"])) == [count]
    assert found(*both, "--since", "1h", "--client", "a client of another name") == []
    assert found(*both, "--since", "1h", "--sort", "action") == [pick, count, other]
    names = {line.split()[1] for line in here("goals", *both, url=url).lines[1:]}
    assert names == {"/fibonacci", "/arm/pick"}
    for options, none in (
        (("fibonacci", "--status", "canceling", "--status", "aborted"), "canceling or aborted"),
        ((*both, "--until", "2026-01-31"), "matching"),
    ):
        of_names = "/fibonacci" if none != "matching" else "/fibonacci or /arm/pick"
        err = here("goals", *options, url=url).err
        assert err == f"There are no {none} goals of {of_names}.\n"


def test_a_name_is_relative_to_the_namespace_unless_it_has_a_slash(here: Run, tcp: str) -> None:
    inside = detached(here, tcp, "arm/pick", "object_name: cup")
    outside = detached(here, tcp, "fibonacci", "order: 1")

    assert inside in here("goals", "pick", "-n", "arm", url=tcp).out
    assert outside in here("goals", "/fibonacci", "-n", "arm", url=tcp).out
    error = here("goals", "fibonacci", "-n", "arm", url=tcp).err
    assert error.startswith("Error: the action /arm/fibonacci is not served; did you mean ")


@pytest.mark.parametrize("columns", [80, 160])
def test_a_watched_list_is_kept_up_to_date_where_it_is(
    terminal: Open, here: Run, tcp: str, columns: int
) -> None:
    goal_id = detached(here, tcp, "wait", "{seconds: 60, steps: 600}")
    short = goal_id[:8]
    shown = terminal("goals", "wait", "--watch", url=tcp, columns=columns)
    shown.until(rf"^{short}\w* +EXECUTING")
    here("cancel", goal_id, url=tcp)
    screen = shown.until(lambda lines: any(short in one and "CANCELED" in one for one in lines))
    shown.press("\x03")

    assert shown.ends() == 0
    assert sum(short in line for line in screen) == 1
    assert screen[0].startswith("ID ")
    assert shown.text.count("FEEDBACK") == 1
    assert not shown.cursor_hidden


def test_a_server_that_dies_and_one_that_stops_are_told_of(
    started: Start, start_robot: Callable[[], Robot]
) -> None:
    stopped, died = start_robot(), start_robot()
    first = started("goals", "--watch", "--json", url=stopped.unix)
    second = started("echo", "wait", url=f"{died.tcp}?reconnect=false")
    for robot, process in ((stopped, first), (died, second)):
        started("send_goal", "wait", "{seconds: 600}", url=robot.tcp)
        lines_until("EXECUTING", process)
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


async def running_goals(url: str, *names: str) -> int:
    with anyio.fail_after(20):
        return await list_goals.list_goals(url, names)


@pytest.mark.asyncio
async def test_without_goals_there_is_a_remark(capsys: pytest.CaptureFixture[str]) -> None:
    async with serve(counter("one"), "inproc://goals"):
        assert await running_goals("inproc://goals") == 0
        assert await running_goals("inproc://goals", "one") == 0
        assert await list_goals.list_goals("inproc://goals", form=Form.JSON) == 0

    out, err = capsys.readouterr()
    assert out == ""
    assert err == "There are no goals.\nThere are no goals of /one.\n"


async def end_at_once(_: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield "done"


def remembering() -> ActionServer[int, int, str]:
    """A server that remembers its goals for longer than any test takes."""
    action = Action("one", goal=int, feedback=int, result=str)
    return ActionServer(action, end_at_once, result_timeout=3600)


@pytest.mark.asyncio
@pytest.mark.parametrize(("goals", "text"), [(1, "1 goal"), (2, "2 goals")])
async def test_a_list_for_programs_tells_of_results_that_it_does_not_have(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, goals: int, text: str
) -> None:
    async def give_none(_self: object, _clients: object, rows: object, _timeout: float) -> object:
        return rows

    monkeypatch.setattr(Outcomes, "of", give_none)
    server, url = remembering(), "inproc://goals"
    async with serve(server, url), connect(url, server.action) as client:
        for number in range(goals):
            await client.call(number)
        assert await list_goals.list_goals(url, form=Form.JSON) == 0

    out, err = capsys.readouterr()
    assert len(out.splitlines()) == goals
    assert err == f"The result of {text} is left out: the server did not give it.\n"


@pytest.mark.asyncio
async def test_a_list_for_programs_has_the_results_of_more_goals_than_a_screen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    server, url = remembering(), "inproc://goals"
    async with serve(server, url), connect(url, server.action) as client:
        for number in range(MOST_ENDS + 1):
            await client.call(number)
        assert await list_goals.list_goals(url, form=Form.JSON) == 0

    out, err = capsys.readouterr()
    assert [json.loads(line)["result"] for line in out.splitlines()] == ["done"] * (MOST_ENDS + 1)
    assert err == ""


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Console:
    """A terminal of 80 columns and 10 lines."""
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=10, highlight=False)
    monkeypatch.setattr(list_goals, "on_terminal", lambda: True)
    monkeypatch.setattr(list_goals, "console", lambda: console)
    monkeypatch.setattr(list_goals, "UPDATE_PAUSE", 0.01)
    monkeypatch.setattr(list_goals, "AWAY_TIMEOUT", 0.05)
    return console


def drawn(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.asyncio
async def test_on_a_terminal_it_is_colored(screen: Console) -> None:
    server = counter("one")
    async with serve(server, "inproc://goals"):
        await ActionClient(server, server.action).send_goal(1)
        assert await running_goals("inproc://goals") == 0

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

    monkeypatch.setattr(list_goals, "picture", record)
    async with server, anyio.create_task_group() as tasks:
        await ActionClient(server, server.action).send_goal(1)
        tasks.start_soon(list_goals._watch_screen, served.connection, None)
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
@pytest.mark.parametrize("name", [None, "one"])
async def test_a_watched_list_ends_with_ctrl_c(screen: Console, name: str | None) -> None:
    codes: list[int] = []

    async def run() -> None:
        codes.append(await list_goals.watch_goals("inproc://goals", name, as_json=False))

    async with serve(counter("one"), "inproc://goals"):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run)
            with anyio.fail_after(30):
                while "active" not in drawn(screen):  # noqa: ASYNC110 - a file has no events
                    await anyio.sleep(0.01)
            signal.raise_signal(signal.SIGINT)

    assert codes == [0]


@pytest.mark.asyncio
async def test_elsewhere_each_change_is_a_line() -> None:
    server, url = counter("one"), "inproc://goals"
    async with serve(server, url), connect(url, server.action) as client:
        await client.send_goal(1, goal_id=ID)
        watch = partial(list_goals.watch_goals, url)
        plain = await echoed(partial(watch, as_json=False), "EXECUTING")
        events = await echoed(partial(watch, "one", as_json=True), "EXECUTING")

    assert plain[0].endswith(f"  {ID}  EXECUTING  /one  1  -")
    assert json.loads(events[0])["status"] == "EXECUTING"


@pytest.mark.asyncio
async def test_a_watched_namespace_has_no_changes_of_others() -> None:
    robots, url = [counter("robot1/one"), counter("robot10/one")], "inproc://goals"
    async with serve(robots, url), connect(url) as connection:
        for robot in reversed(robots):
            await connection.client(robot.action).send_goal(1)
        watch = partial(list_goals.watch_goals, url, namespace=Namespace("/robot1"))
        lines = await echoed(partial(watch, as_json=True), "EXECUTING")

    assert {json.loads(line)["action"] for line in lines} == {"robot1/one"}


@pytest.mark.anyio
@in_virtual_time()
async def test_the_connection_is_checked_for_a_moment() -> None:
    server = counter("one")
    altered = Altered(server)
    client = Served(altered).connection.client(server.action)

    async def seconds(clients: list[AnyClient]) -> float:
        start = anyio.current_time()
        await list_goals._check_connection(clients)
        return anyio.current_time() - start

    assert await seconds([client]) == pytest.approx(list_goals.AWAY_TIMEOUT)  # it does not run yet
    assert await seconds([]) == pytest.approx(list_goals.AWAY_TIMEOUT)
    async with server:
        assert await seconds([client]) == 0

    async def lost() -> None:
        raise ConnectionLost("the line is dead")

    altered.calls["wait_for_server"] = lost
    with pytest.raises(ConnectionLost):
        await seconds([client])
