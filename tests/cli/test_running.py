"""`serve` and `bridge`: as processes that get signals, and piece by piece in this one."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM
from threading import Event, Thread
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionInfo, ActionServer, GoalID, connect, serve
from fibaction.abc import Connection, Endpoint
from fibaction.cli import reloading, running
from fibaction.cli.app import ExitCode, Failure
from fibaction.exceptions import ServerNotFound, TransportError
from tests.cli.conftest import (
    PATIENCE,
    Invoke,
    Open,
    Run,
    Start,
    ended,
    lines_until,
)
from tests.fibonacci import FIBONACCI, fibonacci

MODULE = """
from collections.abc import AsyncGenerator

import anyio

from fibaction import Action, ActionServer, GoalHandle, GoalRejected

COUNT = Action("count", goal=int, feedback=int, result=str)
TELL = Action("arm/tell", goal=str, feedback=int, result=str)


def on_goal(goal: int) -> None:
    if goal < 0:
        raise GoalRejected("one cannot count down")


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    try:
        for number in range(goal.request):
            yield number
        await anyio.sleep(0 if goal.request < 100 else 3600)
    finally:
        if goal.request == 666:
            print("it does not want to go", flush=True)
            with anyio.CancelScope(shield=True):
                await anyio.sleep(3600)
    yield "counted"


async def tell(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    yield goal.request


server = ActionServer(COUNT, count, on_goal=on_goal, shutdown_timeout=600)
several = (server, ActionServer(TELL, tell))
nested = type("Namespace", (), {"server": server})
empty = []
mixed = [server, 3]
number = 3


def make():
    return [ActionServer(TELL, tell)]


def make_one(name):
    return server


def make_nothing():
    return None


def fail():
    raise RuntimeError("the arm is not plugged in")


async def make_later():
    return server
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder with the module `robot` in it."""
    (tmp_path / "robot.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


def eventually(condition: Callable[[], bool]) -> None:
    """Wait, in a thread, for something that tells nobody."""
    for _ in range(int(PATIENCE / 0.02)):
        if condition():
            return
        Event().wait(0.02)
    raise AssertionError(condition)


# serve, as a process


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_serve_runs_servers_at_several_urls_until_a_signal_comes(
    folder: Path, started: Start, fibaction: Run, number: signal.Signals
) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:several", "tcp://127.0.0.1:0", unix)
    (said,) = lines_until("serving", server)
    match = re.fullmatch(
        rf"serving /count, /arm/tell at (tcp://127.0.0.1:\d+), {unix}, Ctrl-C stops it\n", said
    )
    assert match
    for url in (match[1], unix):
        assert fibaction("list", url=url).lines == ["/arm/tell", "/count"]
    assert fibaction("send_goal", "count", "3", url=unix).code == ExitCode.SUCCEEDED
    assert fibaction("send_goal", "count", "-- -3", url=unix).code == ExitCode.USAGE
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


def test_the_usual_url_is_the_default(folder: Path, started: Start, fibaction: Run) -> None:
    unix = f"unix://{folder}/socket"
    server = started("serve", "robot:server", url=unix)

    assert lines_until("", server) == [f"serving /count at {unix}, Ctrl-C stops it\n"]
    assert fibaction("list", url=unix).lines == ["/count"]


def test_a_second_ctrl_c_ends_at_once(folder: Path, terminal: Open, fibaction: Run) -> None:
    unix = f"unix://{folder}/socket"
    server = terminal("serve", "robot:server", unix)
    server.until("Ctrl-C stops it")
    assert fibaction("send_goal", "count", "666", "--detach", url=unix).code == 0
    server.press("\x03")
    server.until("it does not want to go")
    # Ctrl-C twice within a moment would count as one.
    while server.process.poll() is None:
        server.press("\x03")
        with suppress(subprocess.TimeoutExpired):
            server.process.wait(running.SAME_SIGNAL)

    assert server.process.returncode == -SIGINT


# serve, in this process


NO_SERVER = "and not an ActionServer or several; there is robot:server"
ASYNC = "is an async function, and not an ActionServer or what gives one; there is robot:server"
NO_ARGUMENTS = "cannot be called without arguments: missing"
NO_MODULE = "is not written as module:server"


@pytest.mark.parametrize(
    ("target", "error"),
    [
        ("robot", f"'robot' {NO_MODULE}; did you mean robot:server?"),
        ("./arm/robot.py:x", f"'./arm/robot.py:x' {NO_MODULE}; did you mean arm.robot:x?"),
        (":server", f"':server' {NO_MODULE}"),
        ("robott:server", "there is no module 'robott'; did you mean robot?"),
        ("robot.arm:server", "there is no module 'robot.arm'"),
        ("package.servr:x", "there is no module 'package.servr'; did you mean package.server?"),
        ("zzz.servr:x", "there is no module 'zzz' in {folder}, nor installed"),
        ("robot:servr", "robot has no 'servr'; did you mean robot:server?"),
        ("robot:zzz", "robot has no 'zzz'; there is server"),
        ("robot:nested.zzz", "robot has no 'nested.zzz'; there is server"),
        ("robot:number.zzz", "robot has no 'number.zzz'"),
        ("package.server:zzz", "package.server has no 'zzz'"),
        ("package.server:x", "package.server:x gives nothing, and not an ActionServer or several"),
        ("robot:number", f"robot:number gives something of type int, {NO_SERVER}"),
        ("robot:empty", f"robot:empty gives nothing, {NO_SERVER}"),
        ("robot:mixed", f"robot:mixed gives in the list something of type int, {NO_SERVER}"),
        ("robot:make_nothing", f"robot:make_nothing gives something of type NoneType, {NO_SERVER}"),
        (
            "robot:make_one",
            f"robot:make_one {NO_ARGUMENTS} a required argument: 'name'; there is robot:server",
        ),
        ("robot:count", f"robot:count {ASYNC}"),
        ("robot:make_later", f"robot:make_later {ASYNC}"),
        ("robot:fail", "robot:fail: robot.py, line 55: RuntimeError: the arm is not plugged in"),
        ("wrong:server", "wrong:server: wrong.py, line 2: SyntaxError: '(' was never closed"),
        (
            "needs:server",
            "needs:server: needs.py, line 1: ModuleNotFoundError: No module named 'no_such_thing'",
        ),
        ("stops:server", "stops:server: stops.py, line 1: AssertionError"),
    ],
)
def test_what_cannot_be_served_is_one_sentence(
    folder: Path, invoke: Invoke, target: str, error: str
) -> None:
    (folder / "wrong.py").write_text("\nprint(\n")
    (folder / "needs.py").write_text("import no_such_thing\n")
    (folder / "stops.py").write_text("assert False\n")
    (folder / "package").mkdir()
    (folder / "package" / "__init__.py").touch()
    (folder / "package" / "server.py").write_text("x = []")
    result = invoke("serve", target, f"unix://{folder}/socket")

    assert result.exit_code == ExitCode.USAGE
    assert result.stdout == ""
    assert result.stderr == f"Error: {error.format(folder=folder)}\n"


def test_a_wrong_module_is_no_traceback_in_a_process_either(folder: Path, fibaction: Run) -> None:
    code, out, err = fibaction("serve", "robt:server")

    assert (code, out) == (2, "")
    assert err == "Error: there is no module 'robt'; did you mean robot?\n"


@pytest.mark.parametrize("target", ["robot:server", "robot:nested.server", "robot:several"])
def test_servers_are_found(folder: Path, target: str) -> None:
    assert running.load(target)[0].action.name == "count"


def test_reload_is_left_to_the_module_that_can_do_it(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, tuple[str, ...]]] = []

    async def serve_reloading(target: str, urls: tuple[str, ...]) -> int:
        asked.append((target, urls))
        return 0

    monkeypatch.setattr(reloading, "serve_reloading", serve_reloading)

    assert invoke("serve", "robot:server", "unix:///run/robot", "--reload").exit_code == 0
    assert asked == [("robot:server", ("unix:///run/robot",))]


def test_the_current_folder_is_looked_at_first_and_once(folder: Path) -> None:
    running.load("robot:server")
    running.load("robot:server")

    assert sys.path[0] == str(folder)
    assert sys.path.count(str(folder)) == 1


def test_a_function_may_give_the_servers(folder: Path) -> None:
    assert [server.action.name for server in running.load("robot:make")] == ["arm/tell"]


def test_a_callable_that_does_not_say_what_it_takes_is_called(folder: Path) -> None:
    with pytest.raises(Failure, match="of type dict"):
        running.load("builtins:dict")


def test_ctrl_c_during_the_import_is_no_error(folder: Path, invoke: Invoke) -> None:
    (folder / "slow.py").write_text("raise KeyboardInterrupt\n")

    assert invoke("serve", "slow:server").exit_code == ExitCode.INTERRUPTED


def test_a_url_that_cannot_be_served_at_is_one_sentence(folder: Path, invoke: Invoke) -> None:
    result = invoke("serve", "robot:make", "tcp://0.0.0.0:0")

    assert result.exit_code == ExitCode.USAGE
    assert "can be reached from other machines" in result.stderr.splitlines()[-1]


def test_a_signal_ends_it_with_code_0_and_the_log_is_as_before(
    folder: Path, invoke: Invoke
) -> None:
    root = logging.getLogger()
    before = (root.level, root.handlers[:])

    def stop_it() -> None:
        eventually((folder / "socket").exists)
        os.kill(os.getpid(), SIGTERM)

    thread = Thread(target=stop_it)
    thread.start()
    result = invoke("serve", "robot:make", f"unix://{folder}/socket")
    thread.join()

    assert result.exit_code == 0
    assert result.stdout == f"serving /arm/tell at unix://{folder}/socket, Ctrl-C stops it\n"
    assert "action server 'arm/tell' has stopped" in result.stderr
    assert (root.level, root.handlers) == before


@pytest.mark.asyncio
async def test_each_change_of_a_goal_is_logged_and_that_it_is_forgotten_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    server = ActionServer(FIBONACCI, fibonacci, result_timeout=0)
    with caplog.at_level(logging.INFO, running.__name__):
        async with running.serving([server], f"unix://{tmp_path}/socket") as (url,):
            async with connect(url, FIBONACCI) as client:
                await client.call(FIBONACCI.goal.type(3))

    assert [
        message.rpartition(": ")[2]
        for name, _, message in caplog.record_tuples
        if name == running.__name__
    ] == ["ACCEPTED", "EXECUTING", "SUCCEEDED"]


@pytest.mark.asyncio
async def test_the_second_signal_ends_it_if_it_is_not_the_first_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[object] = []
    ended_by = anyio.Event()

    def end_by(number: signal.Signals) -> None:
        told.append(number)
        ended_by.set()

    monkeypatch.setattr(running, "end_by", end_by)
    with anyio.fail_after(PATIENCE):
        async with running.stop_signals(lambda: told.append("at once")) as stop:
            os.kill(os.getpid(), SIGINT)
            await stop.wait()
            os.kill(os.getpid(), SIGTERM)
            await anyio.sleep(running.SAME_SIGNAL)  # it is the time that is tested
            assert told == []
            os.kill(os.getpid(), SIGTERM)
            await ended_by.wait()

    assert told == ["at once", SIGTERM]


def test_the_end_by_a_signal_is_that_of_a_process_that_does_not_handle_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, int]] = []
    before = signal.getsignal(SIGTERM)
    monkeypatch.setattr(os, "kill", lambda *arguments: sent.append(arguments))
    try:
        running.end_by(SIGTERM)
        assert signal.getsignal(SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(SIGTERM, before)

    assert sent == [(os.getpid(), SIGTERM)]


# bridge, as a process


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_a_bridge_serves_all_that_there_is_until_a_signal_comes(
    tmp_path: Path, started: Start, fibaction: Run, tcp: str, number: signal.Signals
) -> None:
    near = f"unix://{tmp_path}/socket"
    bridge = started("bridge", tcp, near)
    (said,) = lines_until("", bridge)
    assert said.startswith("bridging /")
    assert said.endswith(f" from {tcp} to {near}, Ctrl-C stops it\n")
    assert fibaction("list", "-t", url=near).lines == fibaction("list", "-t", url=tcp).lines
    done = fibaction("send_goal", "fibonacci", "order: 4", "-f", url=near)
    assert (done.code, done.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    assert fibaction("send_goal", "arm/pick", "object_name: sun", url=near).code == 4
    assert fibaction("send_goal", "wait", "-t", "0.3", url=near).code == 5
    bridge.send_signal(number)
    code, _, err = ended(bridge)

    assert code == 0
    assert "Traceback" not in err


def test_a_bridge_waits_for_what_is_named_and_survives_the_server(
    tmp_path: Path, folder: Path, started: Start, fibaction: Run
) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    bridge = started("bridge", far, near, "count")
    assert bridge.stderr is not None
    assert bridge.stderr.readline() == "waiting for /count\n"
    server = started("serve", "robot:several", far)
    lines_until("bridging /count from", bridge)
    assert fibaction("list", url=near).lines == ["/count"]

    server.send_signal(SIGKILL)
    server.wait(PATIENCE)
    client = started("send_goal", "count", "3", url=near)
    again = started("serve", "robot:several", far)
    code, out, _ = ended(client)
    assert (code, out.splitlines()[-1]) == (0, "Goal finished with status: SUCCEEDED")
    again.send_signal(SIGTERM)
    assert ended(again).code == 0


def test_the_goals_go_on_when_a_bridge_is_stopped(
    tmp_path: Path, started: Start, fibaction: Run, tcp: str
) -> None:
    near = f"unix://{tmp_path}/near"
    bridge = started("bridge", tcp, near, "wait")
    lines_until("bridging", bridge)
    done = fibaction("send_goal", "wait", "seconds: 0.5", "--detach", url=near)
    bridge.send_signal(SIGTERM)
    assert ended(bridge).code == 0
    status = started("bridge", tcp, near, "wait")
    lines_until("bridging", status)

    assert asked_for(near, "wait", done.out.strip()) == "SUCCEEDED"


def asked_for(url: str, name: str, goal_id: str) -> str:
    """How a goal ends."""

    async def ask() -> str:
        async with connect(url, Action.untyped(ActionInfo(name))) as client:
            with anyio.fail_after(PATIENCE):
                goal = await client.attach(GoalID(bytes.fromhex(goal_id)))
                return (await goal.outcome()).status.name

    return anyio.run(ask)


# bridge, in this process


def test_a_bridge_that_leads_nowhere_is_one_sentence(invoke: Invoke, nobody: str) -> None:
    result = invoke("bridge", nobody, nobody)
    assert result.exit_code == ExitCode.USAGE
    assert result.stderr == "Error: a bridge from a URL to itself would lead nowhere\n"

    result = invoke("bridge", nobody, "unix:///tmp/never")
    assert result.exit_code == ExitCode.UNREACHABLE
    assert result.stderr.startswith(f"Error: nobody listens at {nobody} ")

    result = invoke("bridge", "morse://", "unix:///tmp/never")
    assert result.exit_code == ExitCode.USAGE
    assert result.stderr.startswith("Error: no transport for morse://")


@pytest.mark.asyncio
async def test_a_signal_ends_a_bridge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    codes: list[int] = []

    async def run() -> None:
        codes.append(await running.bridge(far, near, ()))

    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(FIBONACCI, fibonacci), far):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(run)
                async with connect(near, FIBONACCI) as client:
                    await client.wait_for_server()
                os.kill(os.getpid(), SIGINT)

    assert codes == [0]
    said = f"bridging /fibonacci from {far} to {near}, Ctrl-C stops it\n"
    assert capsys.readouterr().out == said


@pytest.mark.asyncio
async def test_a_signal_ends_a_bridge_that_waits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = f"unix://{tmp_path}/far"

    async def stop() -> None:
        await anyio.to_thread.run_sync(eventually, lambda: "waiting" in capsys.readouterr().err)
        os.kill(os.getpid(), SIGINT)

    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(stop)
            assert await running.bridge(far, f"unix://{tmp_path}/near", ["fibonacci"]) == 0


class House(Connection):
    """A connection that knows some actions, and has lost some more."""

    def __init__(self, *lists: list[str], lost: str = "") -> None:
        self._lists = list(lists)
        self._lost = lost
        self.server = ActionServer(FIBONACCI, fibonacci)

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
        if action.name == self._lost:
            raise TransportError("its type is not known")
        return self.server

    async def actions(self) -> list[ActionInfo]:
        if not self._lists:
            raise ServerNotFound("there is nobody")
        names = self._lists.pop(0) if len(self._lists) > 1 else self._lists[0]
        return [ActionInfo(name) for name in names]


@pytest.mark.asyncio
async def test_what_is_named_is_waited_for_and_the_near_name_suggested(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "LOOK_PAUSE", 0.01)
    house = House(["wait"], ["wait"], ["wait", "/weight"])
    with anyio.fail_after(PATIENCE):
        found = await running._wait_for(["/wait", "weight", "wait"], house, anyio.Event())

    assert [info.name for info in found] == ["wait", "/weight"]
    assert capsys.readouterr().err == (
        "nobody serves the action /weight; did you mean /wait?: waiting for /weight\n"
    )


def test_what_has_no_type_here_is_left_out_unless_it_was_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    house, infos = House(lost="b"), [ActionInfo("a"), ActionInfo("b")]

    assert list(running._endpoints(house, infos, choose=True)) == [house.server]
    assert capsys.readouterr().err == "/b is left out: its type is not known\n"
    with pytest.raises(TransportError, match="its type is not known"):
        list(running._endpoints(house, infos, choose=False))


@pytest.mark.asyncio
async def test_where_no_action_is_there_is_nothing_to_bridge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serve([], "tcp://127.0.0.1:0") as (url,):
        with pytest.raises(Failure, match="there is no action to bridge") as caught:
            await running.bridge(url, "unix:///tmp/never", ())

    assert caught.value.exit_code == ExitCode.UNREACHABLE
