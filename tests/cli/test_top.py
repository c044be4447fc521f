"""`top` as a process in a terminal, and without what it needs."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from fibaction import ConnectionLost
from fibaction.cli.output.lines import LogHandler
from fibaction.cli.output.screen import TopScreen
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.verbs import top
from tests.cli.conftest import Invoke, Open, Robot, Run
from tests.cli.served import Altered, Served, counter, look_often

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
    monkeypatch.setattr(top, "sys", sys_with_terminals(but=missing))
    monkeypatch.setattr(top, "show", None)

    result = invoke("top", url=tcp)

    assert (result.exit_code, result.stderr) == (ExitCode.USAGE, NEEDS_TERMINAL)


# Here


def test_the_command_runs_the_screen(
    invoke: Invoke, tcp: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []

    async def show(_: object, url: str) -> None:
        shown.append(url)

    monkeypatch.setattr(top, "show", show)
    monkeypatch.setattr(top, "sys", sys_with_terminals())

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
        for number in range(top.MOST_LINES + 1):
            logging.getLogger("fibaction.wire").warning("line %d is bad", number)
        before.append(capsys.readouterr().err)
        screen.exit()

    monkeypatch.setattr(TopScreen, "on_mount", on_mount)
    with anyio.fail_after(20):
        await top.show(Served(counter("one")).connection, "inproc://top")

    assert before == [""]
    said = capsys.readouterr().err.splitlines()
    assert said == [f"line {number} is bad" for number in range(1, top.MOST_LINES + 1)]
    assert root.handlers == [handler]


@pytest.mark.asyncio
@pytest.mark.usefixtures("without_terminal")
async def test_an_error_of_the_connection_ends_it() -> None:
    async def lost() -> None:
        raise ConnectionLost("the line is dead")

    server = Altered(counter("one"), status=lost, wait_for_server=lost)
    with anyio.fail_after(20):
        with pytest.raises(ExceptionGroup) as errors:
            await top.show(Served(server).connection, "inproc://top?token=secret")

    assert errors.group_contains(ConnectionLost)
