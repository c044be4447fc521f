"""`serve --reload`: real files that change, and real processes that are started anew."""

from __future__ import annotations

import logging
import os
import re
import socket
import sys
from collections.abc import AsyncGenerator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM
from types import ModuleType

import anyio
import pytest

from fibaction import Action, ActionInfo, GoalStatus, connect
from fibaction.cli import reloading
from fibaction.cli.ending import ExitCode, Failure
from tests.cli.conftest import Invoke, Open, Run, Start, eventually
from tests.processes import PATIENCE, ended, lines_until

MODULE = """
from collections.abc import AsyncGenerator

import anyio

from fibaction import Action, ActionServer, GoalHandle

TELL = Action("NAME", goal=int, feedback=int, result=str)


async def tell(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield goal.request
    await anyio.sleep(goal.request)
    yield "TEXT"


server = ActionServer(TELL, tell)
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


def test_a_change_ends_the_goals_and_the_next_server_is_reached_at_the_same_url(
    file: Path, tmp_path: Path, started: Start, fibaction: Run
) -> None:
    url = f"unix://{tmp_path}/socket"
    server = started("serve", "reloaded:server", url, "tcp://127.0.0.1:0", "--reload")
    (first,) = lines_until("", server)
    assert re.fullmatch(rf"serving /tell at {url}, tcp://127.0.0.1:\d+, Ctrl-C stops it\n", first)
    assert fibaction("send_goal", "tell", "0", url=url).out.endswith(said("first"))
    client = started("send_goal", "tell", "3600", "-f", url=url)
    lines_until("Feedback", client)
    file.write_text(module(text="second"))
    code, out, _ = ended(client)
    assert code == 1
    assert out.splitlines()[-1] == "Goal finished with status: ABORTED (server stopped)"
    # The next one is being started now, and the goal waits for it.
    done = fibaction("send_goal", "tell", "0", url=url)
    assert (done.code, done.err) == (0, "")
    assert done.out.endswith(said("second"))
    assert lines_until("", server) == [first]  # it serves again, and the URLs were kept

    server.send_signal(SIGTERM)
    code, out, log = ended(server)
    assert (code, out) == (0, "")
    assert "reloaded.py changed: starting again\n" in log
    assert "fibaction-" not in log  # nobody needs to know how it is done
    assert "Traceback" not in log


def test_a_syntax_error_is_shown_and_the_next_change_is_waited_for(
    file: Path, tmp_path: Path, started: Start, fibaction: Run
) -> None:
    url = f"unix://{tmp_path}/socket"
    file.write_text("print(\n")
    server = started("serve", "reloaded:server", url, "--reload")
    assert server.stderr is not None
    assert server.stderr.readline() == (
        "Error: reloaded:server: reloaded.py, line 1: SyntaxError: '(' was never closed\n"
    )
    assert server.stderr.readline() == (
        "the servers have ended with exit code 2: waiting for a change\n"
    )
    file.write_text(module("other"))
    lines_until("serving /other", server)
    file.write_text("1 +\n")
    lines_until("SyntaxError", server, errors=True)
    assert fibaction("list", url=url).lines == ["/other"]
    file.write_text(module("another"))
    lines_until("serving /another", server)
    assert fibaction("list", url=url).lines == ["/another"]
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


def test_servers_do_not_outlive_the_process_that_has_started_them(
    file: Path, tmp_path: Path, started: Start
) -> None:
    # The server has stderr open, too: its end is the end of both.
    url = f"unix://{tmp_path}/socket"
    leftovers = {"TMPDIR": str(tmp_path)}
    server = started("serve", "reloaded:server", url, "--reload", env=leftovers)
    lines_until("serving", server)
    server.send_signal(SIGKILL)

    assert ended(server).code == -SIGKILL


# In this process


@asynccontextmanager
async def reloads(url: str) -> AsyncGenerator[list[int], None]:
    """`serve_reloading` for the module `reloaded`, stopped at the end; gives its exit code."""
    codes: list[int] = []

    async def run() -> None:
        codes.append(await reloading.serve_reloading("reloaded:server", [url]))

    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run)
            async with connect(url) as connection:
                await connection.endpoint(ActionInfo("tell")).wait_for_server()
            yield codes
            os.kill(os.getpid(), SIGTERM)


@pytest.mark.asyncio
async def test_a_change_of_the_actions_is_announced(
    file: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "fibaction.wire")
    url = f"unix://{tmp_path}/socket"
    async with reloads(url) as codes, connect(url) as connection:
        await anyio.Path(file).write_text(module("other"))
        await connection.endpoint(ActionInfo("other")).wait_for_server()
        assert [info.name for info in await connection.actions()] == ["other"]

    assert codes == [0]
    assert capfd.readouterr().out == (
        f"serving /tell at {url}, Ctrl-C stops it\nserving /other at {url}, Ctrl-C stops it\n"
    )
    assert "left: the client has what it wanted" in caplog.text
    assert "fibaction-" not in caplog.text  # nobody needs to know how it is done


@pytest.mark.asyncio
async def test_servers_that_end_by_themselves_are_told_of(
    file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ends = module().replace('    yield "first"', "    import os; os._exit(7)")
    await anyio.Path(file).write_text(ends)
    url = f"unix://{tmp_path}/socket"
    tell = Action("tell", goal=int, feedback=int, result=str)

    def has_ended(code: int) -> bool:
        return f"ended with exit code {code}: waiting for a change" in capfd.readouterr().err

    async with reloads(url), connect(url, tell) as client:
        goal = await client.send_goal(1)
        await anyio.to_thread.run_sync(eventually, lambda: has_ended(7))
        await anyio.Path(file).write_text("1 +\n")
        await anyio.to_thread.run_sync(eventually, lambda: has_ended(2))
        await anyio.Path(file).write_text(module(text="second"))
        assert (await goal.outcome()).status is GoalStatus.UNKNOWN
        assert await client.call(0) == "second"

    assert "changed: starting again" in capfd.readouterr().err


@pytest.mark.asyncio
async def test_a_process_that_ends_before_it_is_looked_at_is_waited_for(tmp_path: Path) -> None:
    life = reloading.Life("reloaded:server", f"unix://{tmp_path}/nobody?reconnect=no", tmp_path)

    await life._look()

    assert life._infos is None


@pytest.mark.asyncio
async def test_a_second_signal_kills_the_servers_as_well(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    life = reloading.Life("reloaded:server", f"unix://{tmp_path}/socket", tmp_path)
    life.kill()  # there is none yet
    ours, theirs = socket.socketpair()
    with ours, theirs:
        life._process = process = await life._start(theirs.fileno())
        life.kill()
        with anyio.fail_after(PATIENCE):
            assert await process.wait() == -SIGKILL
        life.kill()  # there is none any more


@pytest.mark.parametrize(("name", "folder"), [("reloaded", "."), ("package.arm.server", "package")])
def test_the_folder_is_that_of_the_module_or_of_the_outermost_package(
    file: Path, name: str, folder: str
) -> None:
    (file.parent / "package" / "arm").mkdir(parents=True)

    assert reloading.folder_of(name) == (file.parent / folder).resolve()


@pytest.mark.parametrize(
    ("target", "error"),
    [
        ("reloded:server", "there is no module 'reloded'; did you mean reloaded?"),
        ("sys:server", "the module 'sys' has no folder that could change"),
        ("reloaded", "'reloaded' is not written as module:server; did you mean reloaded:server?"),
    ],
)
def test_a_wrong_module_is_one_sentence(
    file: Path, invoke: Invoke, target: str, error: str
) -> None:
    result = invoke("serve", target, "--reload")

    assert (result.exit_code, result.stderr) == (ExitCode.USAGE, f"Error: {error}\n")


def test_without_watchfiles_one_sentence_says_so(
    file: Path, invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reloading, "find_spec", lambda _: None)
    result = invoke("serve", "reloaded:server", "--reload")

    assert result.exit_code == ExitCode.USAGE
    assert result.stderr == "Error: --reload needs watchfiles: pip install 'fibaction[reload]'\n"


def test_without_unix_sockets_one_sentence_says_so(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reloading, "socket", ModuleType("socket"))
    with pytest.raises(Failure, match="--reload needs Unix sockets") as caught:
        anyio.run(reloading.serve_reloading, "reloaded:server", [])

    assert caught.value.exit_code == ExitCode.USAGE


# The process that serves, in this process


def be_the_child(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> object:
    """Run the main function of the process that serves; gives what it exits with."""
    monkeypatch.setattr(sys, "argv", ["-c", *arguments])
    with pytest.raises(SystemExit) as caught:
        reloading.main()
    return caught.value.code


def test_the_process_says_when_it_serves_and_stops_when_its_parent_is_gone(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reloading._wire, "setLevel", lambda _: None)
    ours, theirs = socket.socketpair()
    with ours:
        ours.shutdown(socket.SHUT_WR)  # it serves all the same, for a moment
        url = f"unix://{tmp_path}/socket"
        code = be_the_child(monkeypatch, str(theirs.detach()), "reloaded:server", url)
        assert ours.recv(10) == reloading.READY

    assert code == 0


def test_the_process_says_what_is_wrong(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reloading._wire, "setLevel", lambda _: None)
    ours, theirs = socket.socketpair()
    with ours:
        code = be_the_child(monkeypatch, str(theirs.detach()), "reloaded:srver", "unix:///never")

    assert code == ExitCode.USAGE
    assert capsys.readouterr().err == (
        "Error: reloaded has no 'srver'; did you mean reloaded:server?\n"
    )
