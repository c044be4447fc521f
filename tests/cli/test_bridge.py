"""`bridge`: as a process that gets signals, and piece by piece in this one."""

from __future__ import annotations

import os
import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionInfo, ActionServer, connect, serve
from fibaction.border.abc import Connection, Endpoint
from fibaction.cli.bridge.ends import Renames
from fibaction.cli.bridge.sources import BridgedActions
from fibaction.cli.process.exit_codes import ExitCode, Failure
from fibaction.cli.verbs import bridge
from fibaction.words.errors import ServerNotFound, TransportError
from fibaction_transports.inprocess import InProcessTransport
from tests.cli.conftest import Run, Start, detached, eventually
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.processes import PATIENCE, ended, lines_until

# bridge, as a process


@pytest.mark.parametrize("number", [SIGINT, SIGTERM])
def test_a_bridge_serves_all_that_there_is_until_a_signal_comes(
    tmp_path: Path, started: Start, here: Run, tcp: str, number: signal.Signals
) -> None:
    near = f"unix://{tmp_path}/socket"
    bridge = started("bridge", tcp, near)
    (said,) = lines_until("", bridge)
    assert said.startswith("bridging /")
    assert said.endswith(f" from {tcp} to {near}, Ctrl-C stops it\n")
    assert here("list", "-t", url=near).lines == here("list", "-t", url=tcp).lines
    done = here("send_goal", "fibonacci", "order: 4", "-f", url=near)
    assert (done.code, done.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    assert here("send_goal", "arm/pick", "object_name: sun", url=near).code == 4
    assert here("send_goal", "wait", "-t", "0.3", url=near).code == 5
    bridge.send_signal(number)
    code, _, err = ended(bridge)

    assert code == 0
    assert "Traceback" not in err


def test_a_bridge_waits_for_what_is_named_and_survives_the_server(
    tmp_path: Path, folder: Path, started: Start, here: Run
) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    bridge = started("bridge", far, near, "count")
    assert bridge.stderr is not None
    assert bridge.stderr.readline() == "waiting for /count\n"
    server = started("serve", "robot:several", far)
    lines_until("bridging /count from", bridge)
    assert here("list", url=near).lines == ["/count"]

    server.send_signal(SIGKILL)
    server.wait(PATIENCE)
    client = started("send_goal", "count", "3", url=near)
    again = started("serve", "robot:several", far)
    code, out, _ = ended(client)
    assert (code, out.splitlines()[-1]) == (0, "Goal finished with status: SUCCEEDED")
    again.send_signal(SIGTERM)
    assert ended(again).code == 0


def test_a_bridge_of_several_urls_serves_each_in_a_namespace_and_waits_for_those_that_are_away(
    tmp_path: Path, folder: Path, started: Start, here: Run, tcp: str
) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    bridge = started("bridge", f"arm={tcp}", f"base={far}", near)
    (said,) = lines_until("", bridge)
    assert said == f"bridging from {tcp}, {far} to {near}, Ctrl-C stops it\n"
    assert bridge.stderr is not None
    told = ""
    server = started("serve", "robot:several", far)
    while not ("served as /arm/fibonacci" in told and "served as /base/count" in told):
        told += bridge.stderr.readline()
    for name, goal in (("arm/fibonacci", "order: 4"), ("base/count", "3")):
        done = here("send_goal", name, goal, url=near)
        assert (done.code, done.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    for process in (server, bridge):
        process.send_signal(SIGTERM)
        assert ended(process).code == 0


def test_the_goals_go_on_when_a_bridge_is_stopped(
    tmp_path: Path, started: Start, here: Run, tcp: str
) -> None:
    near = f"unix://{tmp_path}/near"
    bridge = started("bridge", tcp, near, "wait")
    lines_until("bridging", bridge)
    goal_id = detached(here, near, "wait", "seconds: 0.5")
    bridge.send_signal(SIGTERM)
    assert ended(bridge).code == 0
    assert here("attach", goal_id, url=tcp).code == ExitCode.SUCCEEDED


# bridge, in this process


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
            assert await bridge.bridge(far, f"unix://{tmp_path}/near", ["fibonacci"]) == 0


@pytest.mark.parametrize("names", [(), ("fibonacci",)])
@pytest.mark.asyncio
async def test_a_bridge_keeps_the_tokens_in_its_urls_to_itself(
    names: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"

    async def stop() -> None:
        async with connect(near, FIBONACCI) as client:
            await client.wait_for_server()
        os.kill(os.getpid(), SIGINT)

    with anyio.fail_after(PATIENCE):
        async with serve([], far):
            with pytest.raises(Failure) as caught:
                await bridge.bridge(f"{far}?token=secret", near, ())
        async with serve(ActionServer(FIBONACCI, fibonacci), far):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(stop)
                assert await bridge.bridge(f"{far}?token=secret", f"{near}?heartbeat=1", names) == 0

    assert caught.value.message == f"there is no action to bridge at {far}"
    said = f"bridging /fibonacci from {far} to {near}, Ctrl-C stops it\n"
    assert capsys.readouterr().out == said


class House(Connection):
    """A connection that knows some actions, and then others."""

    def __init__(self, *lists: list[str]) -> None:
        self._lists = list(lists)
        self.server = ActionServer(FIBONACCI, fibonacci)

    def endpoint(self, action: Action[Any, Any, Any] | ActionInfo) -> Endpoint:
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
    monkeypatch.setattr(bridge, "LOOK_PAUSE", 0.01)
    house = House(["wait"], ["wait"], ["wait", "/weight"])
    with anyio.fail_after(PATIENCE):
        found = await bridge._wait_for(["/wait", "weight", "wait"], house, anyio.Event())

    assert [info.name for info in found] == ["wait", "/weight"]
    assert capsys.readouterr().err == (
        "the action /weight is not served; did you mean /wait?: waiting for /weight\n"
    )


@pytest.mark.asyncio
async def test_a_bridge_that_is_stopped_while_it_looks_has_nothing_to_complain_about(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @asynccontextmanager
    async def stopped() -> AsyncGenerator[anyio.Event, None]:
        stop = anyio.Event()
        stop.set()
        yield stop

    monkeypatch.setattr(bridge, "stop_signals", stopped)
    async with serve([], "tcp://127.0.0.1:0") as (url,):
        assert await bridge.bridge(url, "unix:///tmp/never", ()) == ExitCode.SUCCEEDED


# Actions that come and go


def test_actions_that_come_later_are_bridged_and_those_that_leave_are_not(
    tmp_path: Path, folder: Path, started: Start, here: Run
) -> None:
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    server = started("serve", "robot:server", far)
    lines_until("serving", server)
    bridge = started("bridge", far, near, "--into", "/lab/arm")
    lines_until("bridging /lab/arm/count from", bridge)
    server.send_signal(SIGTERM)
    assert ended(server).code == 0
    server = started("serve", "robot:several", far)
    lines_until("serving", server)

    eventually(lambda: len(here("list", url=near).lines) > 1)
    many = here("list", url=near).lines
    assert all(name.startswith("/lab/arm/") for name in many)
    client = here("send_goal", "lab/arm/count", "3", url=near)
    assert (client.code, client.lines[-1]) == (0, "Goal finished with status: SUCCEEDED")
    server.send_signal(SIGKILL)
    server.wait(PATIENCE)
    server = started("serve", "robot:server", far)
    lines_until("serving", server)
    eventually(lambda: here("list", url=near).lines == ["/lab/arm/count"])
    bridge.send_signal(SIGTERM)
    code, _, err = ended(bridge)
    assert code == 0
    assert "has come, and is served as /lab/arm/" in err
    assert "has gone" in err


@pytest.mark.asyncio
async def test_where_no_action_can_be_used_there_is_nothing_to_bridge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Renames, endpoint: Endpoint) -> Endpoint:
        raise TransportError("its type is not installed")

    monkeypatch.setattr(Renames, "endpoint", refuse)
    far, near = f"unix://{tmp_path}/far", f"unix://{tmp_path}/near"
    async with serve(ActionServer(FIBONACCI, fibonacci), far):
        with pytest.raises(Failure, match="there is no action to bridge"):
            await bridge.bridge(far, near, ())
        assert capsys.readouterr().err == "/fibonacci is left out: its type is not installed\n"
        with pytest.raises(TransportError, match="its type is not installed"):
            await bridge.bridge(far, near, ["fibonacci"])


@pytest.mark.asyncio
async def test_where_actions_stay_the_same_changes_are_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(InProcessTransport, "shares_address", False)
    far, near = f"unix://{tmp_path}/far", "inproc://bridge_fixed"

    async def stop() -> None:
        async with connect(near, FIBONACCI) as client:
            await client.wait_for_server()
        os.kill(os.getpid(), SIGINT)

    def followed(self: BridgedActions) -> None:
        raise AssertionError

    monkeypatch.setattr(BridgedActions, "follow", followed)
    with anyio.fail_after(PATIENCE):
        async with serve(ActionServer(FIBONACCI, fibonacci), far):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(stop)
                assert await bridge.bridge(far, near, ()) == 0


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--into", "/robot1", "-n", "/arm"), ["/robot1/pick"]),
        (("fibonacci", "arm/pick", "--rename", "arm/pick=grasp"), ["/fibonacci", "/grasp"]),
        (("pick", "-n", "/arm", "--into", "/a", "--rename", "pick=b/grasp"), ["/a/b/grasp"]),
    ],
)
def test_actions_get_the_names_that_the_options_say(
    options: tuple[str, ...],
    expected: list[str],
    tmp_path: Path,
    started: Start,
    here: Run,
    tcp: str,
) -> None:
    near = f"unix://{tmp_path}/socket"
    bridge = started("bridge", tcp, near, *options)
    lines_until("bridging", bridge)

    assert sorted(here("list", url=near).lines) == expected


def test_a_bridge_of_several_urls_ends_by_a_signal(
    tmp_path: Path, nobody: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        signal.raise_signal(SIGTERM)

    monkeypatch.setattr(bridge, "say", say)
    near = f"unix://{tmp_path}/near"
    assert anyio.run(bridge.bridge_several, {"arm": nobody, "base": nobody}, near) == 0
    assert said == [f"bridging from {nobody}, {nobody} to {near}, Ctrl-C stops it"]
