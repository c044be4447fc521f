"""`serve`: as a process that gets signals, and piece by piece in this one."""

from __future__ import annotations

import gc
import logging
import os
import re
import signal
import socket
import subprocess
import urllib.request
import weakref
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from fibaction import ActionServer, GoalRejected, SqliteStore, connect
from fibaction.cli.process.exit_codes import ExitCode
from fibaction.cli.process.signals import SAME_SIGNAL
from fibaction.cli.verbs import serve
from fibaction.testing import ScriptedServer
from fibaction_transports.inprocess import InProcessTransport
from tests.cli.conftest import Invoke, Open, Run, Start, detached
from tests.cli.robot_module import MODULE
from tests.support.fibonacci import FIBONACCI, Goal, Result, fibonacci
from tests.support.processes import ended, lines_until

# serve, as a process


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_serve_runs_servers_at_several_urls_until_a_signal_comes(
    folder: Path, started: Start, here: Run, number: signal.Signals
) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:several", "tcp://127.0.0.1:0", unix)
    (said,) = lines_until("serving", server)
    match = re.fullmatch(
        rf"serving /count, /arm/tell at (tcp://127.0.0.1:\d+), {unix}, Ctrl-C stops it\n", said
    )
    assert match
    for url in (match[1], unix):
        assert here("list", url=url).lines == ["/arm/tell", "/count"]
    assert here("send_goal", "count", "3", url=unix).code == ExitCode.SUCCEEDED
    assert here("send_goal", "count", "-- -3", url=unix).code == ExitCode.USAGE
    client = started("send_goal", "count", "100", "-f", url=match[1])
    lines_until("99", client)
    server.send_signal(number)
    code, out, _ = ended(client)
    assert (code, out.splitlines()[-1]) == (
        1,
        "Goal finished with status: ABORTED (server stopped)",
    )
    code, _, log = ended(server)

    assert code == 0
    changes = re.findall(r"^\d.* goal \w{32} of action 'count': (\w+)$", log, re.MULTILINE)
    assert changes == ["ACCEPTED", "EXECUTING", "SUCCEEDED", "ACCEPTED", "EXECUTING", "ABORTED"]
    assert "action server 'arm/tell' has stopped" in log
    assert "Traceback" not in log


def test_the_usual_url_is_the_default(folder: Path, started: Start, here: Run) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:server", url=unix)

    assert lines_until("", server) == [f"serving /count at {unix}, Ctrl-C stops it\n"]
    assert here("list", url=unix).lines == ["/count"]


@pytest.mark.parametrize(
    ("order", "sign"),
    [
        ("666", "it does not want to go"),
        ("667", "it does not want to go"),
        ("668", "action server 'count' has stopped"),
    ],
    ids=["a clean-up takes long", "a clean-up holds the event loop up", "a thread is left over"],
)
def test_a_second_ctrl_c_ends_at_once_and_quietly(
    folder: Path, terminal: Open, here: Run, order: str, sign: str
) -> None:
    unix = f"unix://{folder}/socket"
    server = terminal("serve", "robot:server", unix)
    server.until("Ctrl-C stops it")
    assert here("send_goal", "count", order, "--detach", url=unix).code == 0
    server.until("it is at work")
    server.press("\x03")
    server.until(sign)
    # Ctrl-C twice within a moment would count as one.
    while server.process.poll() is None:
        server.press("\x03")
        with suppress(subprocess.TimeoutExpired):
            server.process.wait(SAME_SIGNAL)

    server.ends()
    assert server.process.returncode == -SIGINT
    assert not re.search("Traceback|Exception|Interrupt", server.text)


def test_metrics_of_goals_are_served_until_the_servers_stop(
    folder: Path, started: Start, here: Run
) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:several", unix, "--metrics", ":0")
    lines = lines_until("serving", server)
    found = re.fullmatch(r"metrics at (http://127.0.0.1:\d+/metrics)\n", lines[0])
    assert found
    assert here("send_goal", "count", "3", url=unix).code == ExitCode.SUCCEEDED
    with urllib.request.urlopen(found[1], timeout=10) as response:
        text = response.read().decode()
    server.send_signal(SIGINT)

    assert 'fibaction_goals_total{action="count",status="SUCCEEDED"} 1.0' in text
    assert ended(server)[0] == 0


# serve, in this process


def test_a_used_address_is_one_sentence_and_nothing_else(folder: Path, invoke: Invoke) -> None:
    with socket.create_server(("127.0.0.1", 0)) as used:
        url = f"tcp://127.0.0.1:{used.getsockname()[1]}"
        result = invoke("serve", "robot:make", url)

    assert result.exit_code == ExitCode.USAGE
    assert result.stderr.startswith("Error: ")
    assert url in result.stderr
    assert result.output.count("\n") == 1


def test_reload_is_another_process(invoke: Invoke, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr(serve, "run_reloading", lambda *arguments: asked.append(arguments))
    command = ("serve", "robot:server", "unix:///a", "--reload")

    assert invoke(*command, url="tcp://b").exit_code == 0
    assert invoke(*command, "--store", "goals.db", url="tcp://b").exit_code == 0
    common = ("robot:server", ("unix:///a",), "tcp://b")
    kept = [f"--store={os.path.abspath('goals.db')}", "--sync=full"]
    past = (*command, "--store", "goals.db", "--history", "0.5")
    assert invoke(*past, url="tcp://b").exit_code == 0
    more = ("--drain", "9", "--log-json", "--metrics", ":0", "--record", "a.jsonl")
    assert invoke(*command, *more, url="tcp://b").exit_code == 0
    others = ["--drain=9.0", "--metrics=:0", f"--record={os.path.abspath('a.jsonl')}", "--log-json"]
    given = (kept[:0], 0), (kept, 0), ([*kept, "--history=0.5"], 0), (others, 9)
    assert asked == [(*common, options, drain) for options, drain in given]


def test_ctrl_c_during_the_import_is_an_interruption(folder: Path, invoke: Invoke) -> None:
    (folder / "slow.py").write_text("raise KeyboardInterrupt\n")

    assert invoke("serve", "slow:server").exit_code == ExitCode.INTERRUPTED


def test_a_url_of_this_process_is_served_beside_another(folder: Path, started: Start) -> None:
    both = started("serve", "robot:server", f"unix://{folder}/socket", "inproc://robot")
    assert lines_until("", both) == [
        f"serving /count at unix://{folder}/socket, inproc://robot, Ctrl-C stops it\n"
    ]


def test_names_that_an_address_remaps_are_printed_with_it() -> None:
    class Remapping(InProcessTransport):
        """A transport with other names."""

        def served_as(self, name: str) -> str:
            return f"/robot/sum_of_{name}"

    servers = [ActionServer(FIBONACCI, fibonacci)]
    assert (
        serve._with_names("ros2://", Remapping(), servers) == "ros2:// as /robot/sum_of_fibonacci"
    )
    assert serve._with_names("inproc://a", InProcessTransport("a"), servers) == "inproc://a"


@pytest.mark.asyncio
async def test_each_change_of_a_goal_is_logged_and_that_it_is_forgotten_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server = ActionServer(FIBONACCI, fibonacci, result_timeout=0)
    with caplog.at_level(logging.INFO, serve.__name__):
        async with serve.served([server], f"unix://{tmp_path}/socket") as (url,):
            async with connect(url, FIBONACCI) as client:
                await client.call(FIBONACCI.goal.type(3))

    assert [
        message.rpartition(": ")[2]
        for name, _, message in caplog.record_tuples
        if name == serve.__name__
    ] == ["ACCEPTED", "EXECUTING", "SUCCEEDED"]


# With a store


def test_a_goal_that_has_ended_is_there_after_a_kill(
    folder: Path, started: Start, here: Run
) -> None:
    (folder / "robot.py").write_text(
        f"{MODULE}\nserver = ActionServer(COUNT, count, result_timeout=99)\n"
    )
    unix = f"unix://{folder}/socket"
    command = ("serve", "robot:server", unix, "--store", "goals.db", "--sync", "normal")
    server = started(*command)
    lines_until("serving", server)
    goal_id = detached(here, unix, "count", "3")
    assert here("attach", goal_id, url=unix).code == ExitCode.SUCCEEDED
    second = here(*command)
    assert (second.code, second.out) == (ExitCode.STORE, "")
    assert second.err.startswith(f"Error: cannot keep goals in {folder}/goals.db: it is in use by ")
    assert second.err.count("\n") == 1
    server.kill()
    server.wait()

    (folder / "socket").unlink()
    lines_until("serving", started(*command))
    assert here("attach", goal_id, url=unix).code == ExitCode.SUCCEEDED


@pytest.mark.asyncio
async def test_servers_that_have_a_store_keep_it(tmp_path: Path) -> None:
    own = SqliteStore(tmp_path / "own.db")
    servers = [ActionServer(FIBONACCI, fibonacci, store=own), ActionServer(FIBONACCI, fibonacci)]
    serve.keep_in_file(servers, str(tmp_path / "goals.db"), "full")

    assert servers[0].store is own
    async with servers[1]:
        assert (tmp_path / "goals.db").exists()


@pytest.mark.asyncio
async def test_a_history_is_kept_for_so_many_days(tmp_path: Path) -> None:
    server = ActionServer(FIBONACCI, fibonacci)
    serve.keep_in_file([server], str(tmp_path / "goals.db"), "full", 0.5)
    assert repr(server.store).endswith("history=GoalHistory(seconds=43200.0, goals=10000))")


# Garbage


class Cycle:
    """An object that only the garbage collector frees."""

    def __init__(self) -> None:
        self.me = self


def test_garbage_is_collected_less_often_while_goals_run_and_as_before_afterwards() -> None:
    before = gc.get_threshold()
    with serve.rare_collections():
        assert gc.get_threshold() > before
        gone = weakref.ref(Cycle())
        gc.collect()
        assert gone() is None  # what has been made since then is collected
    assert gc.get_threshold() == before
    assert gc.get_freeze_count() == 0


@pytest.mark.asyncio
async def test_goals_that_run_may_end_before_a_server_that_drains_stops(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    signaled, may_end = anyio.Event(), anyio.Event()

    @asynccontextmanager
    async def stop_signals(_same: float | None) -> AsyncGenerator[anyio.Event, None]:
        yield signaled

    monkeypatch.setattr(serve, "stop_signals", stop_signals)
    server = ScriptedServer(FIBONACCI, [may_end, Result([0])])
    transport = InProcessTransport()
    monkeypatch.setattr(serve, "transport_for", lambda _url: transport)
    ended: list[str] = []
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(partial(served_with_drain, server, ended))
        with anyio.fail_after(30):
            while "serving" not in capsys.readouterr().out:
                await anyio.lowlevel.checkpoint()
            async with connect(transport, FIBONACCI) as client, client.send_goal(Goal(1)) as goal:
                signaled.set()
                with pytest.raises(GoalRejected, match="busy: the server drains"):
                    while True:
                        await client.send_goal(Goal(1))
                        await anyio.lowlevel.checkpoint()
                assert ended == []
                may_end.set()
                assert await goal.result() == Result([0])
    assert ended == ["end"]


async def served_with_drain(server: Any, ended: list[str]) -> None:
    await serve.serve_servers([server], ["x"], drain=30, at_end=lambda: ended.append("end"))
