"""`zenoh://` as users meet it: its URLs, its errors, and servers that come and go."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import uuid
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from threading import Event
from typing import Any

import anyio
import pytest
import zenoh

from fibaction import (
    ActionServer,
    ConnectionLost,
    GoalHandle,
    ServerNotFound,
    TransportError,
    connect,
    serve,
)
from fibaction.border.urls import transport_for
from fibaction_transports.ros2 import ZenohTransport
from fibaction_transports.ros2.client import action_client
from fibaction_transports.ros2.client.presence import Presence
from fibaction_transports.ros2.on_zenoh import node, session
from fibaction_transports.ros2.on_zenoh.config import ATTEMPTS, FILE, OVERRIDE
from fibaction_transports.ros2.on_zenoh.node import NO_ROUTER, ZenohNode, open_node
from fibaction_transports.ros2.on_zenoh.session import ZenohSession
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.ports import free_port
from tests.support.processes import PATIENCE
from tests.support.ros_ends import both_ends
from tests.support.zenoh_router import start_router

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("router")]


def new_url() -> str:
    return f"zenoh://?namespace=/t{uuid.uuid4().hex}"


def apart(url: str) -> str:
    """Return a URL whose node shares no session with those of the plain one, as in another
    process.
    """
    return f"{url}&config=queries_default_timeout=500000"


def test_the_url_has_the_router_and_the_settings_that_a_client_must_share() -> None:
    for url, expected in {
        "zenoh://": "zenoh://",
        "zenoh://robot.local": "zenoh://?locators=tcp/robot.local%3A7447",
        "zenoh://robot.local:1/arm?namespace=/a": "zenoh://?namespace=/a"
        "&locators=tcp/robot.local%3A1",
        "zenoh://[::1]:7/arm?mode=client": "zenoh://?locators=tcp/%5B%3A%3A1%5D%3A7",
        "zenoh://?locators=tls/a:1,tcp/b:2": "zenoh://?locators=tls/a%3A1,tcp/b%3A2",
    }.items():
        made = transport_for(url)
        assert isinstance(made, ZenohTransport)
        assert made.url == expected
        again = transport_for(made.url)
        assert isinstance(again, ZenohTransport)
        assert again.url == expected


async def test_a_configuration_of_ros_is_followed(
    router: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "session.json5"
    file.write_text('{mode: "peer", scouting: {multicast: {enabled: false}}}')
    monkeypatch.setenv(FILE, str(file))
    monkeypatch.setenv(
        OVERRIDE, f'mode="client";no/such/key=1;connect/endpoints=["tcp/127.0.0.1:{router}"]'
    )
    async with both_ends(new_url()) as client:
        assert await client.call(Goal(3)) == Result([0, 1, 1, 2])
    assert f"{OVERRIDE}: no/such/key=1 is not valid, and ignored" in caplog.text


@pytest.mark.parametrize("mode", ["peer", "client"])
async def test_both_modes_reach_the_same_graph(router: int, mode: str) -> None:
    where = f"zenoh://127.0.0.1:{router}/arm?namespace=/t{uuid.uuid4().hex}&mode={mode}&domain_id=7"
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), where) as (url,),
            connect(url) as connection,
        ):
            (info,) = [one for one in await connection.actions() if one.name == "fibonacci"]
            assert info.type_name == FIBONACCI.type_name
            assert info.goal["$defs"]
            (server,) = (await connection.peers("fibonacci")).servers
            assert server.endswith("/arm")
            assert await connection.client(FIBONACCI).call(Goal(1)) == Result([0, 1])


async def test_other_versions_of_the_types_are_told_before_the_first_goal(tmp_path: Path) -> None:
    path = tmp_path / "arduinobot_msgs/action/Fibonacci.action"
    path.parent.mkdir(parents=True)
    path.write_text("int32 order\n---\nint32[] sequence\n---\nint64[] partial_sequence\n")
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), new_url(), search=[str(tmp_path)]) as (url,),
            connect(f"{url}&discovery_timeout=0.5", FIBONACCI) as client,
        ):
            with pytest.raises(TransportError, match="another version of the types"):
                await client.call(Goal(1))


async def test_a_server_that_has_gone_ends_its_goals_as_soon_as_its_tokens_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    nodes: list[ZenohNode] = []
    monkeypatch.setattr(action_client, "WATCH_PAUSE", 10 * PATIENCE)  # the graph tells

    @asynccontextmanager
    async def open_noted(*arguments: Any) -> AsyncGenerator[ZenohNode, None]:
        async with open_node(*arguments) as node:
            nodes.append(node)
            yield node

    async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        yield Feedback([0])
        await anyio.sleep_forever()

    with anyio.fail_after(PATIENCE):
        with monkeypatch.context() as patch:
            patch.setattr(node, "open_node", open_noted)
            serving = serve(ActionServer(FIBONACCI, execute), apart(new_url()))
            (url,) = await serving.__aenter__()
        try:
            async with connect(url, FIBONACCI) as client:
                goal = await client.send_goal(Goal(1))
                await anyio.to_thread.run_sync(nodes[0].session.session.close)  # as if killed
                with pytest.raises(ConnectionLost, match="the server of 'fibonacci' has gone away"):
                    await goal.result()
        finally:
            await serving.__aexit__(None, None, None)


async def test_a_status_list_is_not_given_up_while_a_lost_router_may_explain_what_has_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[bool] = []
    space = f"namespace=/t{uuid.uuid4().hex}"

    def have_gone(presence: Presence, servers: frozenset[bytes]) -> bool:
        """See the tokens of one of two servers go first, and then that the router is lost."""
        if servers:
            looks.append(presence._ros.is_cut)
        return bool(servers) and len(looks) == 1

    async with both_ends(f"zenoh://?{space}") as client:
        with await client.endpoint.status() as statuses:
            await client.call(Goal(1))
            assert await statuses.receive() is not None
            monkeypatch.setattr(Presence, "have_gone", have_gone)
            while len(looks) < 3:  # noqa: ASYNC110  # nothing tells of a look
                await anyio.sleep(0.01)
            await client.call(Goal(1))
            assert await statuses.receive() is not None


@asynccontextmanager
async def restarted(port: int) -> AsyncGenerator[Callable[[], Awaitable[None]], None]:
    """Run a router; gives a function that stops it, and starts it again when it is called twice."""
    routers = [start_router(port)]

    async def change() -> None:
        if routers:
            await anyio.to_thread.run_sync(routers.pop().close)
        else:
            routers.append(start_router(port))

    try:
        yield change
    finally:
        for one in routers:
            await anyio.to_thread.run_sync(one.close)


async def test_peers_go_on_while_their_router_is_away_and_after_it_is_back() -> None:
    port = free_port()
    where = f"zenoh://127.0.0.1:{port}?namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            restarted(port) as change,
            serve(ActionServer(FIBONACCI, fibonacci), apart(where)) as (url,),
            connect(url, FIBONACCI) as client,
        ):
            assert await client.call(Goal(1)) == Result([0, 1])
            for one in session._OPEN.values():
                while not await anyio.to_thread.run_sync(one.session.info.peers_zid):  # noqa: ASYNC110
                    await anyio.sleep(0.01)
            await change()
            assert await client.call(Goal(2)) == Result([0, 1, 1])
            await change()
            assert await client.call(Goal(1)) == Result([0, 1])


def late_handler(node_session: ZenohSession, take: Callable[[Any], None]) -> Any:
    """Return a handler that hears of a lost connection long after the tokens behind it have gone,
    as on a busy machine.
    """

    def arrived(event: Any) -> None:
        if event.kind == zenoh.SampleKind.DELETE:
            Event().wait(0.5)  # in a thread of Zenoh
        node_session.mailbox.put([(take, event)])

    return zenoh.handlers.Callback(arrived, indirect=False)


@pytest.mark.parametrize("reconnect", [True, False])
async def test_a_client_of_a_router_waits_until_it_is_back_and_loses_no_goal(
    reconnect: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO")
    port, go_on = free_port(), anyio.Event()
    monkeypatch.setattr(ZenohSession, "handler", late_handler)

    async def execute(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
        yield Feedback([0])
        await go_on.wait()
        yield Result([0])

    where = f"zenoh://127.0.0.1:{port}?namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            restarted(port) as change,
            serve(ActionServer(FIBONACCI, execute), where) as (url,),
            connect(f"{url}&mode=client&reconnect={str(reconnect).lower()}", FIBONACCI) as client,
        ):
            goal = await client.send_goal(Goal(1))
            assert await anext(goal.feedback) == Feedback([0])
            await change()
            if not reconnect:
                with pytest.raises(ConnectionLost, match="the server of 'fibonacci' has gone away"):
                    await goal.result()
                return
            while "is silent, and is waited for" not in caplog.text:  # noqa: ASYNC110
                await anyio.sleep(0.01)
            await change()
            go_on.set()
            assert await goal.result() == Result([0])
            assert await client.call(Goal(1)) == Result([0])


async def test_a_router_may_come_after_both_ends_and_there_may_be_two() -> None:
    one, two = free_port(), free_port()
    space = f"namespace=/t{uuid.uuid4().hex}"
    with anyio.fail_after(PATIENCE):
        async with (
            serve(ActionServer(FIBONACCI, fibonacci), f"zenoh://127.0.0.1:{one}?{space}"),
            connect(f"zenoh://127.0.0.1:{two}?{space}", FIBONACCI) as client,
            restarted(one),
        ):
            joined = start_router(two, one)
            try:
                await client.wait_for_server()
                assert await client.call(Goal(2)) == Result([0, 1, 1])
            finally:
                await anyio.to_thread.run_sync(joined.close)


@pytest.mark.parametrize(("attempts", "told"), [("2", 2), ("0", 1), ("-1", 0), ("", 1), ("x", 1)])
async def test_a_router_is_looked_for_as_the_environment_says(
    attempts: str, told: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def times() -> int:
        return caplog.text.count(NO_ROUTER.format(f"tcp/127.0.0.1:{port}"))

    monkeypatch.setattr(node, "ROUTER_PAUSE", 0.05)
    monkeypatch.setenv(ATTEMPTS, attempts)
    port = free_port()
    connecting = connect(f"zenoh://127.0.0.1:{port}")
    with anyio.fail_after(PATIENCE):
        if attempts == "0":  # for ever
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(connecting.__aenter__)
                while times() <= 3:  # noqa: ASYNC110
                    await anyio.sleep(0.01)
                tasks.cancel_scope.cancel()
            return
        async with connecting:
            while times() < told:  # noqa: ASYNC110
                await anyio.sleep(0.01)
        assert times() == told


async def test_the_nodes_of_a_process_share_a_session_and_each_removes_what_is_its_own() -> None:
    where = new_url()
    with anyio.fail_after(PATIENCE):
        async with connect(where, FIBONACCI) as client:
            for _ in range(2):
                async with serve(ActionServer(FIBONACCI, fibonacci), where):
                    assert len({one.zid for one in session._OPEN.values()}) == 1
                    await client.wait_for_server()
                    assert await client.call(Goal(1)) == Result([0, 1])
                with pytest.raises(ServerNotFound):
                    await client.call(Goal(1))
    assert not session._OPEN


async def test_a_session_is_opened_when_the_one_before_it_with_the_same_port_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    where = f'zenoh://?config=listen/endpoints=["tcp/127.0.0.1:{free_port()}"]'
    close, begun = session.SharedSession.close, Event()

    def close_slowly(shared: session.SharedSession) -> None:
        begun.set()
        Event().wait(0.2)
        close(shared)

    monkeypatch.setattr(session.SharedSession, "close", close_slowly)

    async def use(when: Callable[[], object]) -> None:
        await anyio.to_thread.run_sync(when)
        async with connect(where):
            pass

    with anyio.fail_after(PATIENCE):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(use, bool)
            tasks.start_soon(use, begun.wait)


async def test_a_session_that_does_not_close_in_time_is_no_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")

    class Slow:
        def __init__(self, inner: zenoh.Session) -> None:
            self.close_inner: Callable[[], object] = inner.close

        def close(self) -> None:
            self.close_inner()
            zenoh.Config.from_json5("{")  # the library's error

    with anyio.fail_after(PATIENCE):
        async with connect(apart(new_url())):
            for shared in session._OPEN.values():
                monkeypatch.setattr(shared, "session", Slow(shared.session))
    assert "a session of Zenoh goes on closing" in caplog.text


async def test_zenohs_own_values_are_followed_and_wrong_ones_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    users = tmp_path / "users"
    users.write_text("me:secret")
    port = free_port()
    router = start_router(port, **{"transport/auth/usrpwd/dictionary_file": str(users)})
    where = f"zenoh://127.0.0.1:{port}?mode=client&config="
    user = 'transport/auth/usrpwd/user="me";transport/auth/usrpwd/password='
    try:
        with anyio.fail_after(PATIENCE):
            async with connect(f'{where}{user}"secret"') as connection:
                assert await connection.actions() == []
            with pytest.raises(TransportError, match="cannot open a session of Zenoh"):
                async with connect(f'{where}{user}"guessed"'):
                    pass  # pragma: no cover
            with pytest.raises(TransportError, match="config: no/such/key=1 is not valid in Zenoh"):
                async with connect(f"{where}no/such/key=1"):
                    pass  # pragma: no cover
    finally:
        await anyio.to_thread.run_sync(router.close)


def test_a_process_that_was_forked_is_told_so() -> None:
    program = """
import os, sys
import anyio
from fibaction import TransportError, connect

async def look():
    async with connect("zenoh://"):
        pass

anyio.run(look)
if (child := os.fork()) == 0:
    try:
        anyio.run(look)
    except TransportError as exc:
        print(exc, flush=True)
    os._exit(0)
os.waitpid(child, 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE
    )
    assert "cannot be used in a process that was forked" in done.stdout
    assert 'multiprocessing with "spawn"' in done.stdout


async def test_a_session_of_another_process_is_not_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "_OPENERS", {os.getpid() - 1})
    with pytest.raises(TransportError, match="forked from one that has used it"):
        async with connect("zenoh://"):
            pass  # pragma: no cover


async def test_a_server_that_stands_still_is_missed_after_its_lease(router: int) -> None:
    program = """
import sys
import anyio
from fibaction import ActionServer, serve
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Feedback

async def execute(goal):
    yield Feedback([0])
    await anyio.sleep_forever()

async def main():
    async with serve(ActionServer(FIBONACCI, execute), sys.argv[1]):
        await anyio.sleep_forever()

anyio.run(main)
"""
    where = f"{new_url()}&lease=0.1"
    with anyio.fail_after(PATIENCE):
        async with connect(where, FIBONACCI) as client:
            process = await anyio.open_process([sys.executable, "-c", program, where])
            try:
                await client.wait_for_server()
                goal = await client.send_goal(Goal(1))
                assert await anext(goal.feedback) == Feedback([0])
                process.send_signal(signal.SIGSTOP)
                with anyio.fail_after(5), pytest.raises(ConnectionLost, match="has gone away"):
                    await goal.result()  # the default would be 10 s
            finally:
                process.kill()
                await process.aclose()


async def test_a_router_with_tls_is_reached_by_those_who_have_its_authority() -> None:
    port, made = free_port(), pems("localhost")
    listening = {"listen_certificate": made.cert, "listen_private_key": made.cert}
    tls = {f"transport/link/tls/{key}": path for key, path in listening.items()}
    router = start_router(port, **{"listen/endpoints": [f"tls/localhost:{port}"], **tls})
    known = f'transport/link/tls/root_ca_certificate="{made.ca}"'
    where = f"zenoh://?locators=tls/localhost:{port}&mode=client"
    try:
        with anyio.fail_after(PATIENCE):
            async with connect(where, config=known) as connection:
                assert await connection.actions() == []
            with pytest.raises(TransportError, match="cannot open a session of Zenoh"):
                async with connect(where):
                    pass  # pragma: no cover
    finally:
        await anyio.to_thread.run_sync(router.close)
