"""`serve --reload`: real files that change, and real processes that are started again."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM
from types import SimpleNamespace
from typing import Any

import click
import pytest
import watchfiles

from fibaction.cli.process import reload
from fibaction.cli.process.exit_codes import ExitCode, Failure
from tests.cli.conftest import Invoke, Open, Run, Start
from tests.support.processes import ended, lines_until

MODULE = """
from collections.abc import AsyncGenerator

import anyio

from fibaction import Action, ActionServer, GoalHandle

TELL = Action("NAME", goal=int, feedback=int, result=str)


async def tell(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield goal.request
    try:
        await anyio.sleep(goal.request)
    finally:
        if goal.request == 666:
            with anyio.CancelScope(shield=True):
                await anyio.sleep(3600)
    yield "TEXT"


server = ActionServer(TELL, tell, shutdown_timeout=600, result_timeout=600)
"""


def module(name: str = "tell", text: str = "first") -> str:
    """The source of a module with a server, whose goals take as many seconds as they say."""
    return MODULE.replace("NAME", name).replace("TEXT", text)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The file of a module `reloaded`, in the current folder."""
    file = tmp_path / "code" / "reloaded.py"
    file.parent.mkdir()
    file.write_text(module())
    monkeypatch.chdir(file.parent)
    monkeypatch.setattr(sys, "path", sys.path[:])
    yield file
    sys.modules.pop("reloaded", None)


def said(goal: str) -> str:
    """How the output of `send_goal` ends, for a goal that succeeds."""
    return f"Result:\n    {goal}\n\nGoal finished with status: SUCCEEDED\n"


# As a process


def test_a_change_ends_the_goals_and_clients_reach_the_next_server_at_the_same_url(
    file: Path, tmp_path: Path, started: Start, here: Run, unused_tcp_port: int
) -> None:
    url, tcp = f"unix://{tmp_path}/socket", f"tcp://127.0.0.1:{unused_tcp_port}"
    server = started("serve", "reloaded:server", url, tcp, "--reload")
    (first,) = lines_until("", server)
    assert first == f"serving /tell at {url}, {tcp}, Ctrl-C stops it\n"
    assert here("send_goal", "tell", "0", url=url).out.endswith(said("first"))
    watching = started("echo", "tell", url=tcp)
    lines_until("SUCCEEDED", watching)
    client = started("send_goal", "tell", "3600", "-f", url=url)
    lines_until("Feedback", client)
    file.write_text(module(text="second"))
    code, out, _ = ended(client)
    assert code == 1
    assert out.splitlines()[-1] == "Goal finished with status: ABORTED (server stopped)"
    assert lines_until("", server) == [first]  # it serves again
    done = here("send_goal", "tell", "0", url=url)
    assert (done.code, done.err) == (0, "")
    assert done.out.endswith(said("second"))
    lines_until("SUCCEEDED", watching)  # a client that was connected before

    server.send_signal(SIGTERM)
    code, out, log = ended(server)
    assert (code, out) == (0, "")
    assert "reloaded.py changed: starting again\n" in log
    assert "Traceback" not in log


def test_a_syntax_error_is_shown_and_the_next_change_is_waited_for(
    file: Path, tmp_path: Path, started: Start, here: Run
) -> None:
    url = f"unix://{tmp_path}/socket"
    file.write_text("print(\n")
    server = started("serve", "reloaded:server", "--reload", url=url)
    assert server.stderr is not None
    assert server.stderr.readline() == (
        "Error: reloaded:server: reloaded.py, line 1: SyntaxError: '(' was never closed\n"
    )
    assert server.stderr.readline() == "the servers have not started: waiting for a change\n"
    file.write_text(module("other"))
    lines_until(f"serving /other at {url}", server)
    file.write_text("1 +\n")
    lines_until("waiting for a change", server, errors=True)
    file.write_text(module("another"))
    lines_until("serving /another", server)
    assert here("list", url=url).lines == ["/another"]
    server.send_signal(SIGINT)
    assert ended(server).code == 0


def test_ctrl_c_tells_the_clients_although_it_goes_to_both_processes(
    file: Path, tmp_path: Path, terminal: Open, started: Start
) -> None:
    url = f"unix://{tmp_path}/socket"
    server = terminal("serve", "reloaded:server", url, "--reload", columns=160)
    server.until("Ctrl-C stops it")
    client = started("send_goal", "tell", "3600", "-f", url=url)
    lines_until("Feedback", client)
    server.press("\x03")

    code, out, _ = ended(client)
    assert code == 1
    assert out.splitlines()[-1] == "Goal finished with status: ABORTED (server stopped)"
    assert server.ends() == 0
    assert "Traceback" not in server.text


def test_a_second_ctrl_c_ends_both_processes_at_once(
    file: Path, tmp_path: Path, terminal: Open, started: Start
) -> None:
    url = f"unix://{tmp_path}/socket"
    server = terminal("serve", "reloaded:server", url, "--reload", columns=160)
    server.until("Ctrl-C stops it")
    client = started("send_goal", "tell", "666", "-f", url=url)
    lines_until("Feedback", client)
    server.press("\x03")
    # Ctrl-C twice within a moment would count as one.
    while server.process.poll() is None:
        with suppress(subprocess.TimeoutExpired):
            server.process.wait(reload.SAME_STOP)
        if server.process.poll() is None:
            server.press("\x03")

    server.ends()
    assert "Traceback" not in server.text


def test_servers_do_not_outlive_the_process_that_has_started_them(
    file: Path, tmp_path: Path, started: Start
) -> None:
    # The server has stderr open, too: its end is the end of both.
    server = started("serve", "reloaded:server", f"unix://{tmp_path}/socket", "--reload")
    lines_until("serving", server)
    server.send_signal(SIGKILL)

    assert ended(server).code == -SIGKILL


# In this process


def test_the_other_process_is_the_command_without_reload(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}

    def run_process(folder: Path, **settings: Any) -> None:
        asked.update(settings, folder=folder)

    monkeypatch.setattr(watchfiles, "run_process", run_process)
    monkeypatch.setenv("FIBACTION_URL", "")
    with pytest.raises(click.exceptions.Exit) as exit:
        reload.run_reloading(
            "reloaded:server",
            ["unix:///a b"],
            "tcp://robot?token=secret",
            ["--store", "a b.db"],
            29.5,
        )

    assert exit.value.exit_code == 0
    assert os.environ["FIBACTION_URL"] == "tcp://robot?token=secret"
    assert asked["folder"] == file.parent
    *_, verb, parent, number, option, path, dashes, target, url = shlex.split(asked["target"])
    assert (verb, parent, number) == ("serve", "--started-by", str(os.getpid()))
    assert (option, path) == ("--store", "a b.db")
    assert (dashes, target, url) == ("--", "reloaded:server", "unix:///a b")
    assert asked["sigint_timeout"] == 35
    counts = asked["watch_filter"]
    assert counts(watchfiles.Change.modified, "/robot/arm.py")
    assert not counts(watchfiles.Change.modified, "/robot/arm.txt")
    assert not counts(watchfiles.Change.modified, "/robot/site-packages/arm.py")
    asked["callback"]({(1, str(file.parent / name)) for name in ("b.py", "a.py")})
    assert capsys.readouterr().err == "a.py, b.py changed: starting again\n"


def test_only_the_first_ctrl_c_interrupts_the_process_that_watches(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_process(*_: object, **__: object) -> None:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(SIGINT)
        signal.raise_signal(SIGINT)  # while it waits for the other process

    monkeypatch.setattr(watchfiles, "run_process", run_process)
    with pytest.raises(click.exceptions.Exit) as exit:
        reload.run_reloading("reloaded:server", [], "tcp://robot")

    assert exit.value.exit_code == 0


def test_without_a_parent_an_error_is_the_callers() -> None:
    with reload.started_by(None):
        pass
    with pytest.raises(Failure), reload.started_by(None):
        raise Failure("it is wrong")


def test_with_a_parent_an_error_is_printed_with_a_remark(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(click.exceptions.Exit) as exit, reload.started_by(os.getppid()):
        raise Failure("it is wrong")

    assert exit.value.exit_code == ExitCode.USAGE
    assert capsys.readouterr().err == (
        "Error: it is wrong\nthe servers have not started: waiting for a change\n"
    )


def test_the_process_stops_when_its_parent_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    parents, sent = iter([5, 5, 1]), []
    system = SimpleNamespace(
        getppid=lambda: next(parents), getpid=lambda: 7, kill=lambda *sending: sent.append(sending)
    )
    pauses: list[float] = []
    monkeypatch.setattr(reload, "os", system)
    monkeypatch.setattr(reload, "Event", lambda: SimpleNamespace(wait=pauses.append))
    reload._stop_without(5)

    assert sent == [(7, SIGTERM)] * 2
    assert pauses == [reload.PERIOD] * 2 + [10 * reload.SAME_STOP] * 2


@pytest.mark.parametrize(("name", "folder"), [("reloaded", "."), ("package.arm.server", "package")])
def test_the_folder_is_that_of_the_module_or_of_the_outermost_package(
    file: Path, name: str, folder: str
) -> None:
    (file.parent / "package" / "arm").mkdir(parents=True)

    assert reload.folder_of(name) == (file.parent / folder).resolve()


def test_where_processes_do_not_fork_one_sentence_says_that_it_is_not_there(
    file: Path, invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "fork")
    result = invoke("serve", "reloaded:server", "--reload")

    needs = "Error: --reload needs Linux or macOS: stop and start the server instead\n"
    assert (result.exit_code, result.stderr) == (ExitCode.USAGE, needs)
