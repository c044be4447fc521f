"""`top`: as a process in a terminal, driven by keys, and piece by piece."""

from __future__ import annotations

import logging
import signal
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from textual.pilot import Pilot
from textual.widgets import DataTable

from fibaction import (
    Action,
    ActionInfo,
    CancelAnswer,
    CancelCode,
    ConnectionLost,
    GoalID,
    GoalInfo,
    GoalStatus,
    Outcome,
    Parent,
)
from fibaction.border.abc import Endpoint
from fibaction.cli.output import screen
from fibaction.cli.output.escape import clean
from fibaction.cli.output.goal_details import Detail, GoalDetails
from fibaction.cli.output.lines import LogHandler
from fibaction.cli.output.screen import ORDERS, GoalView, TopScreen
from fibaction.cli.output.screen_tables import FeedbackText, GoalTable
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import overview
from fibaction.client.events import GoalFeedback
from fibaction.observe.monitor import GoalKey, Monitor
from tests.cli.conftest import Invoke, Open, Robot, Run
from tests.cli.served import Altered, Served, counter, look_often
from tests.support.processes import PATIENCE

NEEDS_TERMINAL = (
    "Error: fibaction top needs a terminal, on stderr as well; fibaction goals --watch does not\n"
)


@pytest.fixture(scope="module")
def robot(start_robot: Callable[[], Robot]) -> Robot:
    """A server process without goals of other files."""
    return start_robot()


@pytest.mark.parametrize("columns", [80, 160])
def test_goals_can_be_watched_followed_and_canceled(
    terminal: Open, here: Run, tcp: str, columns: int
) -> None:
    goal_id = here(
        "send_goal", "wait", "{seconds: 60, steps: 600}", "--detach", url=tcp
    ).out.strip()
    shown = terminal("top", url=tcp, columns=columns)
    shown.until(rf"{goal_id[:8]} +/wait +EXECUTING +━*╸?─*  *\d+% .* step: ")
    # Goals of tests before this one may have come before it, and the cursor is at one of them.
    shown.press("\x1b[A" * 10)
    shown.press("f")
    shown.until(f"/wait {goal_id} EXECUTING")
    shown.until("^ *step: step")
    shown.until("^ *seconds: 60")
    shown.press("c")
    shown.until(rf"Cancel the goal {goal_id[:8]} of /wait\?")
    shown.press("y")
    shown.until(rf"{goal_id[:8]} +/wait +CANCELED")
    assert len(shown.screen) == 24
    shown.press("q")

    assert shown.ends() == 0
    assert not shown.cursor_hidden


def test_a_server_that_is_away_is_shown_and_ctrl_c_leaves(
    terminal: Open, start_robot: Callable[[], Robot]
) -> None:
    robot = start_robot()
    shown = terminal("top", url=f"{robot.tcp}?heartbeat=0.5")
    shown.until("/fibonacci")
    assert "heartbeat" not in shown.text, "what is behind the ? may be secret"
    robot.process.kill()
    shown.until("the server is away")
    shown.press("\x03")

    assert shown.ends() == 0


def test_sigterm_leaves_the_terminal_as_it_was(terminal: Open, tcp: str) -> None:
    shown = terminal("top", url=tcp)
    shown.until("/fibonacci")
    shown.process.send_signal(signal.SIGTERM)

    assert shown.ends() == 0
    assert not shown.cursor_hidden
    assert b"\x1b[?1049l" in shown.raw


def test_a_server_that_does_not_run_is_an_error_before_the_screen_is_taken(
    terminal: Open, nobody: str
) -> None:
    shown = terminal("top", url=nobody)

    assert shown.ends() == ExitCode.UNREACHABLE
    assert f"Error: no server listens at {nobody}" in shown.text
    assert b"\x1b[?1049h" not in shown.raw


STREAMS = ("stdin", "stdout", "stderr")


def sys_with_terminals(*, but: str = "") -> SimpleNamespace:
    """As `sys`, whose streams are terminals, but for one."""
    terminal, file = SimpleNamespace(isatty=lambda: True), SimpleNamespace(isatty=lambda: False)
    return SimpleNamespace(**{name: file if name == but else terminal for name in STREAMS})


@pytest.mark.parametrize("missing", STREAMS)
def test_each_stream_is_needed_for_the_screen(
    missing: str, invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview, "sys", sys_with_terminals(but=missing))
    monkeypatch.setattr(overview, "show", None)

    result = invoke("top", url=tcp)

    assert (result.exit_code, result.stderr) == (ExitCode.USAGE, NEEDS_TERMINAL)


# Here


def test_the_command_runs_the_screen(
    invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []

    async def show(_: object, url: str) -> None:
        shown.append(url)

    monkeypatch.setattr(overview, "show", show)
    monkeypatch.setattr(overview, "sys", sys_with_terminals())

    assert invoke("top", url=tcp).exit_code == 0
    assert shown == [tcp]


@pytest.fixture
def without_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The screen is drawn, but nowhere."""
    run_async = TopScreen.run_async

    async def run(self: TopScreen, **_: Any) -> None:
        await run_async(self, headless=True)

    monkeypatch.setattr(TopScreen, "run_async", run)
    look_often(monkeypatch)


@pytest.mark.asyncio
@pytest.mark.usefixtures("without_terminal")
async def test_what_is_logged_meanwhile_is_written_when_the_screen_is_gone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root, handler = logging.getLogger(), LogHandler()
    monkeypatch.setattr(root, "handlers", [handler])
    before: list[str] = []

    def on_mount(screen: TopScreen) -> None:
        for number in range(overview.MOST_LINES + 1):
            logging.getLogger("fibaction.wire").warning("line %d is bad", number)
        before.append(capsys.readouterr().err)
        screen.exit()

    monkeypatch.setattr(TopScreen, "on_mount", on_mount)
    with anyio.fail_after(20):
        await overview.show(Served(counter("one")).connection, "inproc://top")

    assert before == [""]
    said = capsys.readouterr().err.splitlines()
    assert said == [f"line {number} is bad" for number in range(1, overview.MOST_LINES + 1)]
    assert root.handlers == [handler]


@pytest.mark.asyncio
@pytest.mark.usefixtures("without_terminal")
async def test_an_error_of_the_connection_ends_it() -> None:
    async def lost() -> None:
        raise ConnectionLost("the line is dead")

    server = Altered(counter("one"), status=lost, wait_for_server=lost)
    with anyio.fail_after(20):
        with pytest.raises(ExceptionGroup) as errors:
            await overview.show(Served(server).connection, "inproc://top?token=secret")

    assert errors.group_contains(ConnectionLost)


FIRST, SECOND = GoalID(b"\x11" * 16), GoalID(b"\x22" * 16)


def filled() -> Monitor:
    """A monitor with two actions, and two goals of the first."""
    server = counter("arm/pick")
    monitor = Monitor(summarize=FeedbackText.of)
    pick = ActionInfo("arm/pick", "arm/action/Pick")
    monitor.on_actions([pick, ActionInfo("wait")], "")
    monitor.on_action_found(pick, Served(server).connection.client(server.action))
    monitor.on_action_lost("wait", "its server has stopped")
    monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.EXECUTING, 0, "lab at 1.2.3.4:5"))
    monitor.on_event("arm/pick", GoalInfo(SECOND, 1, GoalStatus.EXECUTING, 0, "me"))
    monitor.on_event("arm/pick", GoalFeedback(FIRST, 41, {"progress": 0.5, "step": "reach " * 30}))
    return monitor


@asynccontextmanager
async def shown(monitor: Monitor, columns: int = 80) -> AsyncGenerator[Pilot[None], None]:
    app = TopScreen(monitor, "tcp://robot:7400")
    async with app.run_test(size=(columns, 24), notifications=True) as pilot:
        with anyio.fail_after(PATIENCE):
            while "q Quit" not in lines(pilot)[-1]:  # the keys come last, a moment later
                await pilot.pause()
        yield pilot


def lines(pilot: Pilot[None]) -> list[str]:
    """What is on the screen."""
    width, height = pilot.app.size
    strips = pilot.app.screen._compositor.render_strips()
    assert len(strips) == height
    texts = [strip.text for strip in strips]
    assert all(len(text) == width for text in texts)
    return [text.rstrip() for text in texts]


async def press(pilot: Pilot[None], *keys: str) -> None:
    """Press keys, and wait until the screen has handled them."""
    await pilot.press(*keys)
    await pilot.pause()


async def until(pilot: Pilot[None], text: str) -> None:
    """Wait until the text is on the screen."""
    with anyio.fail_after(PATIENCE):
        while not any(text in line for line in lines(pilot)):
            await pilot.pause()


def watching(server: Endpoint) -> Monitor:
    """A monitor that has found the action of a server."""
    monitor = Monitor(summarize=FeedbackText.of)
    client = Served(server).connection.client(Action.untyped(server.info))
    monitor.on_action_found(server.info, client)
    return monitor


def find(pilot: Pilot[None], text: str) -> str:
    """The line that has the text."""
    return next(line for line in lines(pilot) if text in line)


@pytest.mark.asyncio
@pytest.mark.parametrize("columns", [80, 160])
async def test_everything_fits_the_width(columns: int) -> None:
    async with shown(filled(), columns) as pilot:
        state, heads = lines(pilot)[:2]
        goals = find(pilot, "LATEST")
        first = find(pilot, "11111111").split()
        assert state == " tcp://robot:7400  2 active, 0 ended, 0.0 feedback/s  newest first"
        assert heads.split() == ["ACTION", "ACTIVE", "ENDED", "FEEDBACK/S", "TYPE"]
        assert find(pilot, "arm/action/Pick").split()[:2] == ["/arm/pick", "2"]
        assert "away: its server has stopped" in find(pilot, " /wait")
        assert first[1:3] == ["/arm/pick", "EXECUTING"]
        assert "41" in first
        assert first[-1].endswith("…"), "what does not fit is seen to be cut"
        assert ("CLIENT" in goals) == ("1.2.3.4:5" in " ".join(first)) == (columns == 160)
        assert "c Cancel goal  f Follow goal  / Filter  s Sort  q Quit" in lines(pilot)[-1]
        for name in ("#actions", "#goals"):
            assert pilot.app.query_one(name).max_scroll_x == 0


@pytest.mark.asyncio
@pytest.mark.parametrize("key", ["f", "enter"])
async def test_a_goal_is_followed_until_it_is_no_more(key: str) -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        await press(pilot, key)
        assert find(pilot, f"/arm/pick {FIRST} EXECUTING")
        assert find(pilot, "progress: 0.5")
        monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.UNKNOWN))
        pilot.app.query_one(DataTable)
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.pause()
        assert find(pilot, f"{FIRST} forgotten by the server")
        await press(pilot, "escape")
        assert not [line for line in lines(pilot) if "progress: 0.5" in line]
        await press(pilot, key)
        assert find(pilot, "No feedback has come while this screen was open.")
        await press(pilot, key)
        assert not [line for line in lines(pilot) if "No feedback has come" in line]


@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["[red]pick", "[/pick]", "[@click=app.quit]pick[/]", "pick\x1b"])
async def test_an_action_may_have_any_name(name: str) -> None:
    monitor = watching(counter("pick"))
    monitor.on_action_found(ActionInfo(name), monitor._client(GoalKey("pick", FIRST)))
    monitor.on_event(name, GoalInfo(FIRST, 2, GoalStatus.EXECUTING))
    async with shown(monitor) as pilot:
        await press(pilot, "f")
        assert find(pilot, f"/{clean(name)} {FIRST} EXECUTING")


@pytest.mark.asyncio
async def test_the_cursor_stays_at_its_goal() -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        await pilot.press("down")
        screen = pilot.app
        assert isinstance(screen, TopScreen)
        assert screen._selected() == GoalKey("arm/pick", SECOND)
        monitor.on_event("arm/pick", GoalInfo(GoalID(b"\x33" * 16), 3, GoalStatus.ACCEPTED))
        screen.draw()
        await pilot.pause()
        assert screen._selected() == GoalKey("arm/pick", SECOND)
        assert screen.query_one("#goals", DataTable).cursor_row == 2
        await pilot.resize_terminal(160, 40)
        assert screen._selected() == GoalKey("arm/pick", SECOND)


@pytest.mark.asyncio
async def test_the_goal_under_the_cursor_is_canceled() -> None:
    server = counter("arm/pick")
    monitor = watching(server)
    async with server, shown(monitor) as pilot:
        await pilot.press("c", "f")  # there is none
        goal = await Served(server).connection.client(server.action).send_goal(1, goal_id=FIRST)
        monitor.on_event("arm/pick", GoalInfo(FIRST, 1, GoalStatus.EXECUTING))
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.press("c", "y")
        await pilot.app.workers.wait_for_complete()
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        await pilot.pause()
        assert find(pilot, "Canceling the goal 11111111")


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("error", "text"),
    [(None, "is not canceled: never"), (ConnectionLost("the line is dead"), "the line is dead")],
)
async def test_what_is_not_canceled_is_told_of(error: ConnectionLost | None, text: str) -> None:
    async def cancel(*_: object) -> CancelAnswer:
        if error is not None:
            raise error
        return CancelAnswer(CancelCode.REJECTED, reason="never")

    server = counter("arm/pick")
    altered = Altered(server, cancel_goals=cancel)
    monitor = watching(altered)
    monitor.on_event("arm/pick", GoalInfo(FIRST, 1, GoalStatus.EXECUTING))
    async with shown(monitor, 160) as pilot:
        await pilot.press("c", "y")
        await pilot.app.workers.wait_for_complete()
        await pilot.pause()
        assert find(pilot, text)


@pytest.mark.asyncio
@pytest.mark.parametrize("key", ["n", "escape"])
async def test_a_goal_is_left_when_the_question_is_answered_with_no(key: str) -> None:
    async with shown(filled()) as pilot:
        await press(pilot, "c")
        assert find(pilot, "Cancel the goal 11111111 of /arm/pick?")
        with anyio.fail_after(PATIENCE):
            while "y Yes, cancel it  n No  q Quit" not in lines(pilot)[-1]:
                await pilot.pause()
        await press(pilot, "f", key, "y")  # neither follows nor cancels
        assert not [line for line in lines(pilot) if "Cancel the goal" in line]
        assert not pilot.app.query_one("#followed").display
        assert not pilot.app.workers


@pytest.mark.asyncio
async def test_goals_are_filtered_while_the_words_are_typed() -> None:
    async with shown(filled(), 160) as pilot:
        await press(pilot, "slash", *"q2222")
        assert "0 of 2 with “q2222”" in lines(pilot)[0]
        await press(pilot, "home", "delete", "enter")
        assert "1 of 2 with “2222”" in lines(pilot)[0]
        assert find(pilot, "22222222")
        assert not [line for line in lines(pilot) if "11111111" in line]
        assert not pilot.app.query_one("#filter").display
        await press(pilot, "escape")
        assert "with" not in lines(pilot)[0]
        assert find(pilot, "11111111")


@pytest.mark.asyncio
async def test_goals_are_sorted_in_the_next_order() -> None:
    async with shown(filled()) as pilot:
        await press(pilot, "s")
        assert lines(pilot)[0].endswith("  oldest first")
        ids = [line.split()[0] for line in lines(pilot) if "EXECUTING" in line]
        assert ids == ["22222222", "11111111"]


@pytest.mark.asyncio
async def test_a_server_that_is_away_is_shown_at_the_top() -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        monitor.on_actions(None, "it does not answer\x1b")
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.pause()
        assert lines(pilot)[0].startswith(
            " tcp://robot:7400  the server is away: it does not answer\\x1b"
        )
        assert pilot.app.query_one("#state").has_class("away")


@pytest.mark.asyncio
async def test_a_screen_that_is_being_taken_down_is_drawn_no_more() -> None:
    async with shown(filled()) as pilot:
        assert isinstance(pilot.app, TopScreen)
        await pilot.app.query_one("#state").remove()
        pilot.app.draw()


@pytest.mark.asyncio
async def test_some_of_many_actions_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screen, "MOST_SHOWN", 2)
    monitor = filled()
    monitor.on_actions([ActionInfo(f"name{number}") for number in range(1000)], "")
    async with shown(monitor) as pilot:
        assert pilot.app.query_one("#actions", DataTable).row_count == 2
        find(pilot, "/arm/pick")  # it has active goals


@pytest.mark.asyncio
async def test_a_goal_that_has_ended_is_shown_with_its_reason_and_result() -> None:
    class Answering(Monitor):
        asked = 0

        async def outcome(self, key: GoalKey) -> Outcome[Any]:
            self.asked += 1
            return Outcome(GoalStatus.ABORTED, {"meters": 2}, "stuck")

    monitor = Answering(summarize=FeedbackText.of)
    monitor.on_actions([ActionInfo("arm/pick")], "")
    monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.ABORTED))
    async with shown(monitor) as pilot:
        await pilot.press("f")
        await until(pilot, "  meters: 2")
        assert find(pilot, "Reason: stuck")
        assert find(pilot, "No feedback has come")
        assert monitor.asked == 1


def goal_id(number: int) -> GoalID:
    return GoalID(bytes([number]) * 16)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def a_view(most: int = 10) -> tuple[GoalView, Monitor, Clock]:
    """A view of four goals: 1 and 3 of arm/pick, 2 and 4 of base/drive; the last has ended."""
    clock = Clock()
    monitor = Monitor(clock=clock)
    monitor.on_actions([ActionInfo("base/drive"), ActionInfo("arm/pick")], "")
    for number, action, status, client in (
        (1, "arm/pick", GoalStatus.EXECUTING, "lab"),
        (2, "base/drive", GoalStatus.CANCELING, "lab"),
        (3, "arm/pick", GoalStatus.EXECUTING, "office"),
        (4, "base/drive", GoalStatus.ABORTED, "office"),
    ):
        parent = Parent(goal_id(1), "to the shelf") if number == 4 else None
        info = GoalInfo(goal_id(number), number, status, 0, client, parent=parent)
        monitor.on_event(action, info)
    return GoalView(monitor, most), monitor, clock


def numbers(view: GoalView) -> list[int]:
    return [goal.info.stamp for goal in view.snapshot().goals]


def test_the_orders_follow_each_other_and_begin_again() -> None:
    view, monitor, clock = a_view()
    monitor.on_event("base/drive", GoalFeedback(goal_id(2), 1, None))
    view.snapshot()
    monitor.on_event("base/drive", GoalFeedback(goal_id(2), 9, None))
    clock.now = 1.0
    found = {}
    for _ in ORDERS:
        found[view.order] = numbers(view)
        view.next_order()

    assert found == {
        "newest first": [3, 2, 1, 4],
        "oldest first": [1, 2, 3, 4],
        "by action": [3, 1, 2, 4],
        "by status": [3, 1, 2, 4],
        "by feedback rate": [2, 3, 1, 4],
    }
    assert view.order == "newest first"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", [3, 2, 1, 4]),
        ("  ", [3, 2, 1, 4]),
        ("/ARM", [3, 1]),
        ("drive abort", [4]),
        ("office", [3, 4]),
        ("0303", [3]),
        ("0101", [1, 4]),
        ("shelf", [4]),
        ("nothing", []),
    ],
)
def test_a_goal_must_have_all_words_of_the_filter(words: str, expected: list[int]) -> None:
    view, _, _ = a_view()
    view.filter = words

    assert numbers(view) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("/robot1", ["/robot1/arm/pick", "robot1/drive"]),
        ("/robot1/", ["/robot1/arm/pick", "robot1/drive"]),
        ("/ROBOT1 pick", ["/robot1/arm/pick"]),
        ("/robot1/arm", ["/robot1/arm/pick"]),
        ("/drive", ["robot1/drive", "robot10/drive"]),
        ("/robot", []),
        ("/1", []),
        ("robot1/", ["/robot1/arm/pick", "robot1/drive"]),
        ("robot1", ["/robot1/arm/pick", "robot1/drive", "robot10/drive"]),
        ("/", ["/robot1/arm/pick", "robot1/drive", "robot10/drive"]),
    ],
)
def test_a_word_with_a_slash_in_front_is_whole_parts_of_a_name(
    words: str, expected: list[str]
) -> None:
    monitor = Monitor()
    for number, name in enumerate(("/robot1/arm/pick", "robot1/drive", "robot10/drive"), 1):
        monitor.on_event(name, GoalInfo(goal_id(number), number, GoalStatus.EXECUTING))
    view = GoalView(monitor, 10)
    view.filter = words

    assert sorted(goal.action for goal in view.snapshot().goals) == expected


def test_the_filter_finds_goals_beyond_those_that_are_shown() -> None:
    view, _, _ = a_view(most=1)
    assert numbers(view) == [3]
    view.filter = "drive"

    found = view.snapshot()
    assert [goal.info.stamp for goal in found.goals] == [2]
    assert found.matching == 2
    assert view.keys == [GoalKey("base/drive", goal_id(2))]


def test_the_cursor_stays_at_its_goal_once_the_goals_have_come() -> None:
    view, monitor, _ = a_view()
    for _ in range(2):
        view.snapshot()
        assert view.place_of(view.key_at(2), 0) == 0
    chosen = view.key_at(0)
    monitor.on_event("arm/pick", GoalInfo(goal_id(5), 5, GoalStatus.EXECUTING))
    view.snapshot()

    assert view.place_of(chosen, 0) == 1
    assert view.key_at(1) == chosen
    assert view.place_of(GoalKey("gone", goal_id(9)), 3) == 0
    assert (view.key_at(-1), view.key_at(5)) == (None, None)


ID = GoalID(b"\x11" * 16)


class Ended(Monitor):
    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        return Outcome(GoalStatus.ABORTED, None, "the cup is gone")


def a_monitor_of(*feedback: Any) -> Monitor:
    """A monitor of a goal that gave this feedback."""
    monitor = Ended(summarize=FeedbackText.of)
    monitor.on_actions([ActionInfo("pick")], "")
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.EXECUTING))
    for number, one in enumerate(feedback, 1):
        monitor.on_event("pick", GoalFeedback(ID, number, one))
    return monitor


def cells(monitor: Monitor, table: GoalTable, width: int = 100) -> dict[str, str]:
    """The cells of the goal by their headings."""
    content = table.table(monitor.snapshot().goals, width, now=0)
    return dict(zip(content.heads, [cell.plain for cell in content.rows[0]], strict=True))


@pytest.mark.parametrize(
    ("feedback", "width", "bar", "rest"),
    [
        ({"progress": 0.45, "step": "grasp"}, 100, "━━━━╸─────  45%", "step: grasp"),
        ({"progress": 0.45, "step": "grasp"}, 80, " 45%", "step: grasp"),
        ({"percent": 100, "left": 0}, 100, "━━━━━━━━━━ 100%", "left: 0"),
        ({"percent": 0}, 100, "──────────   0%", ""),
    ],
)
def test_progress_is_a_bar_and_the_rest_of_the_feedback_is_beside_it(
    feedback: Any, width: int, bar: str, rest: str
) -> None:
    found = cells(a_monitor_of(feedback), GoalTable(GoalDetails(Monitor())), width)

    assert (found["DONE"], found["LATEST"]) == (bar, rest)


def test_a_progress_that_counted_to_hundred_once_does_so_again() -> None:
    monitor = a_monitor_of({"progress": 50})
    table = GoalTable(GoalDetails(monitor))
    assert cells(monitor, table)["DONE"].endswith(" 50%")
    monitor.on_event("pick", GoalFeedback(ID, 2, {"progress": 1}))

    assert cells(monitor, table)["DONE"].endswith("  1%")


def test_feedback_without_progress_needs_no_column_for_it() -> None:
    found = cells(a_monitor_of({"step": "grasp"}), GoalTable(GoalDetails(Monitor())))

    assert "DONE" not in found
    assert found["LATEST"] == "step: grasp"


@pytest.mark.asyncio
async def test_a_goal_that_has_ended_shows_its_end_in_place_of_its_feedback() -> None:
    monitor = a_monitor_of({"progress": 0.5, "step": "grasp"})
    details = GoalDetails(monitor)
    table = GoalTable(details)
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.ABORTED))
    assert cells(monitor, table)["LATEST"] == "step: grasp"
    await details.ask(details.unknown([GoalKey("pick", ID)], []))

    found = cells(monitor, table)
    assert found["LATEST"] == "the cup is gone"
    assert "DONE" not in found


def test_a_wide_screen_has_a_column_of_steps_if_there_are_some() -> None:
    monitor = a_monitor_of()
    table = GoalTable(GoalDetails(monitor))
    assert "PARENT, CHILDREN" not in cells(monitor, table, 120)
    parent = Parent(GoalID(b"\x22" * 16), "reach")
    monitor.on_event("pick", GoalInfo(ID, 0, GoalStatus.EXECUTING, parent=parent))

    assert cells(monitor, table, 120)["PARENT, CHILDREN"] == "reach of 22222222"
    assert "PARENT, CHILDREN" not in cells(monitor, table, 80)


ONE, TWO = (GoalKey("pick", GoalID(bytes([number]) * 16)) for number in (1, 2))


class Answering(Monitor):
    """A monitor with fixed answers; an exception is raised, and None never comes."""

    def __init__(self, outcome: Any = None, request: Any = None) -> None:
        super().__init__()
        self.answers = {"outcome": outcome, "request": request}
        self.asked: list[GoalKey] = []

    async def outcome(self, key: GoalKey) -> Outcome[Any]:
        answer: Outcome[Any] = await self._answer(key, "outcome")
        return answer

    async def request(self, key: GoalKey) -> Any:
        return await self._answer(key, "request")

    async def _answer(self, key: GoalKey, name: str) -> Any:
        self.asked.append(key)
        answer = self.answers[name]
        if isinstance(answer, Exception):
            raise answer
        if answer is Ellipsis:
            await anyio.sleep_forever()
        return answer


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (
            Outcome(GoalStatus.ABORTED, {"meters": 2}, "stuck\x1b"),
            Detail("stuck\\x1b", "Reason: stuck\\x1b\nResult:\n  meters: 2"),
        ),
        (Outcome(GoalStatus.SUCCEEDED, 0), Detail("0", "Result:\n  0")),
        (Outcome(GoalStatus.CANCELED), Detail("", "There is no result.")),
        (ConnectionLost("it is dead"), Detail("", "The result cannot be had: it is dead")),
        (..., Detail("", "The result cannot be had: there was no answer within 0.01 s")),
    ],
)
async def test_the_end_of_a_goal_is_its_reason_and_its_result(
    outcome: Any, expected: Detail
) -> None:
    timeout = 0.01 if outcome is Ellipsis else 10
    details = GoalDetails(Answering(outcome), timeout)
    await details.ask(details.unknown([ONE], []))

    assert details.end(ONE) == expected
    assert details.end(TWO) == Detail("", "")


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("request_", "text"),
    [
        ({"order": 3}, "Goal:\n  order: 3"),
        (None, ""),
        (ConnectionLost("it is dead"), "The goal cannot be had: it is dead"),
    ],
)
async def test_a_goal_is_shown_as_it_was_sent(request_: Any, text: str) -> None:
    details = GoalDetails(Answering(request=request_))
    await details.ask(details.unknown([], [ONE]))

    assert details.request(ONE).text == text


@pytest.mark.asyncio
async def test_each_detail_is_asked_for_once_until_its_goal_is_forgotten() -> None:
    monitor = Answering(Outcome(GoalStatus.CANCELED), 1)
    details = GoalDetails(monitor)
    questions = details.unknown([ONE, TWO], [TWO])
    assert details.unknown([ONE, TWO], [TWO]) == []
    await details.ask(questions)
    details.keep([TWO])
    assert [question.key for question in details.unknown([ONE, TWO], [TWO])] == [ONE]

    assert sorted(monitor.asked) == [ONE, TWO, TWO]
