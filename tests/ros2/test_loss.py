"""A server goes away, in several ways: no wait for it lasts for ever."""

from __future__ import annotations

import logging
import signal
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from pathlib import Path
from time import perf_counter

import anyio
import pytest

from fibaction import (
    ActionClient,
    ClientGoal,
    ConnectionLost,
    GoalAborted,
    GoalRejected,
    GoalStatus,
    ServerNotFound,
    UnknownGoal,
    connect,
)
from fibaction_transports.ros2.on_rclpy.rcl import middleware
from tests.ros2.ends import client_of
from tests.ros2.stock import orders
from tests.ros2.stock.ours import action
from tests.ros2.stock.process import PROFILES_FILE, Peer, peer
from tests.ros2.stock.waiting import eventually
from tests.support.fibonacci import Feedback, Goal, Result

pytestmark = pytest.mark.anyio

LEASE = 3
"""Seconds after which the middleware takes a process for dead. The default of Fast DDS is 20."""
PROFILE = f"""\
<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="short_lease" is_default_profile="true"><rtps><builtin>
    <discovery_config>
      <leaseDuration><sec>{LEASE}</sec></leaseDuration>
      <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
    </discovery_config>
  </builtin></rtps></participant>
</profiles>
"""
CYCLONE_CONFIG = (
    f"<CycloneDDS><Domain><Discovery><LeaseDuration>{LEASE}s</LeaseDuration></Discovery></Domain>"
    "</CycloneDDS>"
)
"""The same for Cyclone DDS, whose default is 10."""
SOON, LEASE_OF_OURS = 3.0, 8.0
"""Seconds that are several times the usual 0.3 and 2.5."""
NOTED = 25.0
"""Seconds for a line of the log. On a busy machine, Fast DDS needs more than ten of them to find a
server again."""
IMPATIENT = "?reconnect_timeout=0.5"
SILENT = "its server is silent, and is waited for"


@pytest.fixture(autouse=True, params=["ros2", "dds"])
def scheme(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients go each way: through rclpy, and over our own DDS."""
    monkeypatch.setitem(WAY, "scheme", request.param)


WAY = {"scheme": "ros2"}


def url_of(rest: str) -> str:
    """Return a URL of the way of the test."""
    return f"{WAY['scheme']}://{rest}"


def server_with_lease(folder: Path, *program: str) -> AbstractAsyncContextManager[Peer]:
    """A server, by default a stock one, that the middleware takes for dead `LEASE` seconds after
    its last message.
    """
    profile = folder / "profile.xml"
    profile.write_text(PROFILE)
    leases = {**dict.fromkeys(PROFILES_FILE, str(profile)), "CYCLONEDDS_URI": CYCLONE_CONFIG}
    return peer(*(program or ("server",)), **leases)


@asynccontextmanager
async def waiting_for(
    server: Peer, name: str, order: int = orders.WAITS, rest: str = IMPATIENT
) -> AsyncGenerator[
    tuple[ActionClient[Goal, Feedback, Result], ClientGoal[Feedback, Result]], None
]:
    async with connect(url_of(rest), action(name)) as client:
        await client.wait_for_server(20)
        goal = await client.send_goal(Goal(order))
        assert await anext(goal.feedback) == Feedback([1])
        yield client, goal


async def lost_after(act: Callable[[], object], goal: ClientGoal[Feedback, Result]) -> float:
    """Return the seconds from the act until every wait for the goal has ended with its loss."""

    async def read() -> None:
        with pytest.raises(ConnectionLost, match="has gone away"):
            async for _ in goal.feedback:
                pass

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(read)
        await anyio.wait_all_tasks_blocked()
        start = perf_counter()
        act()
        with pytest.raises(ConnectionLost, match="has gone away"):
            await goal.result()
    return perf_counter() - start


@pytest.mark.promise("LOSS-1")
async def test_a_server_of_ours_that_is_killed_is_missed_by_its_signs_of_life() -> None:
    async with peer("ours", "serve_it", "loss_killed", "asyncio") as server:
        async with waiting_for(server, "loss_killed") as (client, goal):
            seconds = await lost_after(server.process.kill, goal)
            print(f"SIGKILL of a fibaction server: {seconds:.2f} s")
            assert seconds < LEASE_OF_OURS
            with pytest.raises(ServerNotFound):
                await client.send_goal(Goal(1))


@pytest.mark.promise("GOAL-4", "LOSS-2")
async def test_all_that_is_pending_ends_when_a_server_of_ours_is_killed() -> None:
    ended: list[str] = []

    async with peer("ours", "serve_it", "loss_pending", "asyncio") as server:
        async with waiting_for(server, "loss_pending") as (client, _):
            with await client.endpoint.status() as found:
                server.signal(signal.SIGSTOP)  # it answers nothing any more

                async def end_with_loss(name: str, pending: Callable[[], object]) -> None:
                    with pytest.raises(ConnectionLost):
                        await pending()  # type: ignore[misc]  # all of them are awaitable
                    ended.append(name)

                async def statuses() -> None:
                    while await found.receive() is not None:
                        pass

                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(end_with_loss, "call", lambda: client.call(Goal(1)))
                    tasks.start_soon(end_with_loss, "cancel", client.cancel_goals)
                    tasks.start_soon(end_with_loss, "statuses", statuses)
                    await anyio.wait_all_tasks_blocked()
                    server.process.kill()
                    start = perf_counter()
        assert perf_counter() - start < LEASE_OF_OURS
        assert sorted(ended) == ["call", "cancel", "statuses"]


@pytest.mark.promise("STOP-3", "STOP-8")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_server_of_ours_that_stops_ends_its_goals_first(number: signal.Signals) -> None:
    name = f"loss_{number.name.lower()}"
    async with peer("ours", "serve_it", name, "asyncio") as server:
        async with waiting_for(server, name) as (client, goal):
            start = perf_counter()
            server.signal(number)
            with pytest.raises(GoalAborted):
                await goal.result()
            aborted = perf_counter() - start
            with pytest.raises(ServerNotFound):
                while True:
                    with suppress(GoalRejected, ConnectionLost):  # it stops just now
                        await client.call(Goal(1))
            gone = perf_counter() - start
            print(f"{number.name} to a fibaction server: {aborted:.2f} s, gone: {gone:.2f} s")
            assert gone < LEASE_OF_OURS


async def noted(caplog: pytest.LogCaptureFixture, text: str) -> None:
    with anyio.fail_after(NOTED):
        while text not in caplog.text:  # noqa: ASYNC110  # a log offers nothing to wait for
            await anyio.sleep(0.01)


@pytest.mark.promise("LOSS-2", "LOSS-4")
async def test_calls_go_on_when_a_server_that_was_silent_is_there_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")
    async with peer("ours", "serve_it", "loss_paused", "asyncio") as server:
        async with waiting_for(server, "loss_paused", rest="") as (client, goal):
            results: list[Result] = []

            async def call() -> None:
                results.append(await client.call(Goal(2)))

            async with anyio.create_task_group() as tasks:
                for found_silent in (False, True):
                    server.signal(signal.SIGSTOP)
                    tasks.start_soon(call)
                    if not found_silent:  # this goal is sent before it is known
                        await noted(caplog, SILENT)
                        tasks.start_soon(call)  # and this one afterwards
                        await anyio.wait_all_tasks_blocked()
                    server.signal(signal.SIGCONT)
                    await noted(caplog, "its server is there again")
            assert results == [Result([0, 1, 1])] * 3
            assert (await goal.cancel()).accepted
            assert (await goal.outcome()).status is GoalStatus.CANCELED


async def goes_on_after_it_was_dropped(folder: Path, caplog: pytest.LogCaptureFixture) -> bool:
    """Let the graph drop a silent server, and check that its goal goes on; return False if the
    middleware does not find the server again.
    """
    caplog.clear()
    async with (
        server_with_lease(folder, "ours", "serve_it", "loss_gap", "asyncio") as server,
        waiting_for(server, "loss_gap", rest="") as (client, goal),
    ):
        presence = client_of(client.endpoint).presence

        async def servers() -> int:
            return presence._ros.count_publishers("/loss_gap/_action/status")

        server.signal(signal.SIGSTOP)
        await eventually(servers, lambda number: number == 0)
        server.signal(signal.SIGCONT)
        try:
            await noted(caplog, "its server is there again")
        except TimeoutError:
            if all(one.is_available() for one in presence._clients):
                raise
            return False
        assert (await goal.cancel()).accepted
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        return True


@pytest.mark.timeout(240)
@pytest.mark.promise("LOSS-2", "LOSS-4")
async def test_a_goal_goes_on_although_the_graph_has_dropped_its_silent_server(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")
    for _ in range(4):
        # In 6 of 130 runs Fast DDS has not found the server again, also after 48 s, with shared
        # memory and without it. Nothing is promised then.
        if await goes_on_after_it_was_dropped(tmp_path, caplog):
            break
    else:
        pytest.fail("the middleware has not found the server again, four times")


@pytest.mark.promise("LOSS-6")
async def test_a_server_that_was_killed_and_started_anew_does_not_know_the_goals(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")
    async with peer("ours", "serve_it", "loss_anew", "asyncio") as server:
        async with waiting_for(server, "loss_anew", rest="") as (client, goal):
            server.process.kill()
            await noted(caplog, SILENT)
            async with peer("ours", "serve_it", "loss_anew", "asyncio"):
                with anyio.fail_after(LEASE_OF_OURS):
                    assert (await goal.outcome()).status is GoalStatus.UNKNOWN
                assert await client.call(Goal(2)) == Result([0, 1, 1])


async def holds(look: Callable[[], bool]) -> None:
    async def seen() -> bool:
        return look()

    await eventually(seen, bool)


async def test_an_orderly_stop_after_a_crash_and_a_restart_is_not_taken_for_silence() -> None:
    name = "loss_crashed"
    async with peer("ours", "serve_it", name, "asyncio") as first:
        async with connect("ros2://", action(name)) as client:
            presence = client_of(client.endpoint).presence
            await holds(lambda: presence.is_there() and presence._alive == 1)
            first.process.kill()
            await holds(lambda: not presence.is_there() and presence.may_return())
            async with peer("ours", "serve_it", name, "asyncio") as second:
                await holds(presence.is_there)
                second.signal(signal.SIGTERM)
                assert await second.ended() == 0
                await holds(lambda: not presence.is_there())
                assert not presence.may_return()


async def test_without_reconnect_a_wait_ends_as_soon_as_the_server_is_silent() -> None:
    async with peer("ours", "serve_it", "loss_strict", "asyncio") as server:
        async with waiting_for(server, "loss_strict", rest="?reconnect=false") as (_, goal):
            await lost_after(lambda: server.signal(signal.SIGSTOP), goal)
            server.signal(signal.SIGCONT)


async def test_a_client_with_a_longer_lease_does_not_notice_a_short_silence(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "fibaction.ros2")
    async with peer("ours", "serve_it", "loss_long", "asyncio") as server:
        async with (
            waiting_for(server, "loss_long", rest="long?lease=60") as (patient, _),
            waiting_for(server, "loss_long", rest="short") as (client, _),
        ):
            server.signal(signal.SIGSTOP)
            await noted(caplog, SILENT)
            # Of a reader of Cyclone DDS, the lease of the server counts, not that of the client.
            leases_differ = WAY["scheme"] == "dds" or middleware() != "rmw_cyclonedds_cpp"
            assert client_of(patient.endpoint).presence.is_there() is leases_differ
            assert not client_of(client.endpoint).presence.is_there()
            server.signal(signal.SIGCONT)


async def test_a_stock_server_that_stops_is_missed_at_once() -> None:
    async with peer("tutorial_server") as server:
        async with connect(url_of(""), action("tutorial")) as client:
            await client.wait_for_server(20)
            goal = await client.send_goal(Goal(50))
            assert await anext(goal.feedback) == Feedback([0, 1, 1])

            seconds = await lost_after(lambda: server.signal(signal.SIGINT), goal)

            print(f"SIGINT to a stock server: {seconds:.2f} s")
            assert seconds < SOON


async def test_a_stock_server_that_is_killed_is_missed_when_its_lease_ends(
    tmp_path: Path,
) -> None:
    async with server_with_lease(tmp_path) as server:
        async with waiting_for(server, "stock") as (_, goal):
            seconds = await lost_after(server.process.kill, goal)
            print(f"SIGKILL of a stock server, lease {LEASE} s: {seconds:.2f} s")
            assert seconds < 3 * LEASE


@pytest.mark.promise("GOAL-4", "LOSS-2")
async def test_a_stock_server_that_was_killed_is_missed_although_another_has_taken_its_place(
    tmp_path: Path,
) -> None:
    async with server_with_lease(tmp_path) as first:
        async with waiting_for(first, "stock") as (client, goal):
            presence = client_of(client.endpoint).presence
            ros = presence._ros
            parts = [
                f"/stock/_action/{part}" for part in ("send_goal", "cancel_goal", "get_result")
            ]

            async def servers() -> int:
                """The servers that the client has found with all their parts."""
                topics = [one.publisher_count() for one in presence._subscriptions]
                found = [len(ros.request_readers(part)) for part in parts]
                return int(min(*topics, *found))

            with await client.endpoint.status() as statuses:
                async with peer("server"):  # it is there before the graph misses the other
                    await eventually(servers, lambda number: number == 2)

                    with anyio.fail_after(3 * LEASE):
                        await lost_after(first.process.kill, goal)
                    with anyio.fail_after(SOON):
                        with pytest.raises(ConnectionLost, match="has gone away"):
                            while await statuses.receive() is not None:
                                pass
                        with pytest.raises(UnknownGoal):
                            await client.attach(goal.goal_id)
                    assert await client.goals() == []
                    other = await client.send_goal(Goal(orders.WAITS))
                    assert [one.goal_id for one in await client.goals()] == [other.goal_id]
                    assert (await other.cancel()).accepted
