"""Programs that use ROS 2 end by Ctrl-C or SIGTERM, and leave nothing behind."""

from __future__ import annotations

import re
import signal
import threading
from signal import SIGINT, SIGTERM
from typing import Any

import anyio
import pytest

from fibaction import ConnectionLost, GoalAborted, connect, serve
from tests.ros2.stock import orders
from tests.ros2.stock.ours import Behaviour, action
from tests.ros2.stock.process import Peer, peer
from tests.support.fibonacci import Goal

pytestmark = pytest.mark.anyio

END = 10.0
"""Seconds that a program may take to end; it takes a tenth of one."""
INTERRUPTED = 128 + SIGINT
ABORTED = r"\[WARN\] \[\w+\]: stopped: goal \w+ ABORTED: server stopped\n"
CUT_SHORT = r"Failed to publish log message to rosout: publisher's context is invalid, at \S+\n"
"""rcl's error for a line of the log that is written while rclpy's own handler of signals shuts ROS
down. No check before the line can prevent it."""
KILLED = r"goal \w+ of action '\w+' did not stop in time \(5 s\), and is killed\n"
INTERRUPTED_RUN = r"\[WARN\] \[\w+\]: stopped: goal \w+ ABORTED: KeyboardInterrupt\n"
TORN = r"\S+: RuntimeWarning: coroutine '\S+' was never awaited\n(  .*\n|RuntimeWarning: .*\n)+"
"""On trio, Ctrl-C raises KeyboardInterrupt wherever the program is: also in an executor, where a
goal has ended and no task knows it yet, or a coroutine has been made and not yet started
(https://trio.readthedocs.io/en/stable/reference-lowlevel.html)."""
DEATHS = re.compile("terminate called|core dumped|Fatal|Segmentation")
"""Words of C++ and Python in a crash."""


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def ends(process: Peer, number: signal.Signals, code: int, backend: str = "asyncio") -> None:
    """Check that it ends by a signal without errors: `ours` catches KeyboardInterrupt."""
    process.signal(number)
    assert await process.ended(END) == code, process.complaints()
    excused = f"{ABORTED}|{CUT_SHORT}"
    if (backend, number) == ("trio", SIGINT):
        excused = f"{excused}|{KILLED}|{INTERRUPTED_RUN}|{TORN}"
    rest = re.sub(excused, "", process.complaints())
    assert rest == "", rest


@pytest.mark.parametrize(("number", "code"), [(SIGINT, INTERRUPTED), (SIGTERM, 0)])
@pytest.mark.parametrize("way", ["serve_it", "serve_at_a_node"])
async def test_a_server_with_a_goal_that_runs_ends_by_a_signal(
    anyio_backend: str, way: str, number: signal.Signals, code: int
) -> None:
    async with peer("ours", way, "stopped", anyio_backend) as server:
        async with connect("ros2://", action("stopped")) as client:
            await client.wait_for_server(20)
            goal = await client.send_goal(Goal(orders.WAITS))

            await ends(server, number, code, anyio_backend)

            with pytest.raises((GoalAborted, ConnectionLost)):
                await goal.result()


async def test_a_client_that_waits_for_a_result_ends_by_ctrl_c_and_cancels_its_goal(
    anyio_backend: str,
) -> None:
    async with peer("ours", "serve_it", "waited_for", anyio_backend):
        async with peer("ours", "wait", "waited_for", anyio_backend) as waiting:
            async with connect("ros2://", action("waited_for")) as client:
                await client.wait_for_server(20)
                with await client.endpoint.status() as statuses:
                    await ends(waiting, SIGINT, INTERRUPTED)

                    with anyio.fail_after(END):
                        info = await statuses.receive()
                        while info is not None and info.status.name != "CANCELED":
                            info = await statuses.receive()
                    assert info is not None


async def test_a_client_that_waits_for_a_server_ends_by_ctrl_c(anyio_backend: str) -> None:
    async with peer("ours", "look_for", "nobody", anyio_backend) as looking:
        await ends(looking, SIGINT, INTERRUPTED)


async def test_a_program_may_end_in_the_middle(anyio_backend: str) -> None:
    async with peer("ours", "leave_with_an_error", "left", anyio_backend) as leaving:
        assert await leaving.ended(END) == 7, leaving.complaints()
        assert not DEATHS.search(leaving.complaints()), leaving.complaints()


@pytest.mark.parametrize("anyio_backend", ["asyncio"])  # trio itself does not allow it
async def test_a_program_may_end_without_leaving_its_blocks(anyio_backend: str) -> None:
    async with peer("ours", "abandon", "left", anyio_backend) as leaving:
        assert await leaving.ended(END) == 0, leaving.complaints()
        assert not DEATHS.search(leaving.complaints()), leaving.complaints()


@pytest.mark.parametrize("first", ["server", "client"])
async def test_servers_and_clients_may_leave_in_any_order(first: str) -> None:
    before = set(threading.enumerate())
    server = serve(Behaviour().server("ordered"), "ros2://")
    client = connect("ros2://", action("ordered"))
    if first == "server":
        async with client as found:
            async with server:
                goal = await found.send_goal(Goal(orders.WAITS))
            with pytest.raises(GoalAborted):
                await goal.result()
    else:
        async with server:
            async with client as found:
                goal = await found.send_goal(Goal(orders.WAITS))
            with pytest.raises(ConnectionLost):
                await goal.result()
    assert set(threading.enumerate()) - before == set()
