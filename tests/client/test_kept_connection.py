"""`client = await connect(...)`: a connection without a block, closed by `aclose` in any task."""

from __future__ import annotations

import gc
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio import to_thread

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    ClientConnection,
    ConnectionLost,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    ServerNotFound,
    TransportError,
    __version__,
    connect,
    serve,
)
from fibaction.border.abc import Connection
from fibaction_transports.inprocess import InProcessTransport
from tests.support.one_worker import WORKER, OneWorker

pytestmark = pytest.mark.anyio

COUNT = Action("count", goal=int, feedback=int, result=str)


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    for number in range(1, goal.request + 1):
        yield number
        await anyio.lowlevel.checkpoint()
    yield f"counted to {goal.request}"


FOR_EVER = 10**9


@pytest.fixture
async def url() -> AsyncGenerator[str, None]:
    async with serve(ActionServer(COUNT, count), "tcp://127.0.0.1:0") as (url,):
        yield url


async def test_a_client_is_used_and_closed_in_other_tasks(url: str) -> None:
    clients: list[ActionClient[int, int, str]] = []
    results: list[str] = []

    async def open_it() -> None:
        clients.append(await connect(url, COUNT))

    async def use_it() -> None:
        results.append(await clients[0].call(3))

    async def close_it() -> None:
        await clients[0].aclose()

    for job in (open_it, use_it, close_it, close_it):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(job)
    assert results == ["counted to 3"]
    with pytest.raises(ConnectionLost):
        await clients[0].call(1)


async def test_without_an_action_it_is_a_connection(url: str) -> None:
    connection = await connect(url)
    assert isinstance(connection, ClientConnection)
    assert await connection.actions() == [COUNT.info]
    assert (await connection.peers("count")).servers == (url,)
    assert await connection.nodes() == set()
    assert await connection.client(COUNT).call(1) == "counted to 1"
    with pytest.raises(TransportError, match="are known here as JSON Schemas only"):
        await connection.interface_texts(COUNT.info)
    await connection.aclose()


async def test_closing_cancels_the_goals_of_calls_and_blocks(url: str) -> None:
    client = await connect(url, COUNT)
    errors: list[Exception] = []
    begun = anyio.Event()

    async def call() -> None:
        try:
            await client.call(FOR_EVER, on_feedback=lambda _: begun.set())
        except (ConnectionLost, GoalCanceled) as exc:
            errors.append(exc)

    async with connect(url, COUNT) as other:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(call)
            await begun.wait()
            await client.aclose()
        while (await other.goals())[0].status.is_active:
            pass
        assert [info.status for info in await other.goals()] == [GoalStatus.CANCELED]
    assert len(errors) == 1


async def test_a_client_that_is_forgotten_warns_and_closes_its_connection(url: str) -> None:
    client: Any = await connect(url, COUNT)
    assert await client.call(1) == "counted to 1"
    async with connect(url) as other:
        with pytest.warns(ResourceWarning, match="was not closed: call `await"):  # noqa: PT031  # two make one
            del client
            gc.collect()
        while len((await other.peers("count")).clients) > 1:
            await anyio.lowlevel.checkpoint()


async def test_a_goal_keeps_the_connection_of_its_client(url: str) -> None:
    client: Any = await connect(url, COUNT)
    feedback = (await client.send_goal(50)).feedback
    with pytest.warns(ResourceWarning):  # noqa: PT031  # only the last line warns
        del client
        gc.collect()
        assert [number async for number in feedback] == list(range(1, 51))
        del feedback
        gc.collect()


async def test_a_cancellation_while_connecting_ends_the_connection() -> None:
    ended = anyio.Event()

    class Slow(InProcessTransport):
        """A transport that never connects."""

        @asynccontextmanager
        async def connect(self) -> AsyncGenerator[Connection, None]:
            try:
                await anyio.sleep_forever()
                yield ClientConnection(NotImplemented)
            finally:
                ended.set()

    with anyio.move_on_after(0.01) as scope:
        await connect(Slow(), COUNT)
    assert scope.cancelled_caught
    assert ended.is_set()


async def test_a_client_belongs_to_its_thread(url: str) -> None:
    client = await connect(url, COUNT)
    with pytest.raises(RuntimeError, match="belongs to the event loop of thread"):
        await to_thread.run_sync(anyio.run, client.aclose)
    await client.aclose()


def test_a_program_that_ends_without_closing_ends_cleanly(
    anyio_backend: str, capfd: pytest.CaptureFixture[str]
) -> None:
    kept: list[object] = []

    async def forgets() -> None:
        async with serve(ActionServer(COUNT, count), "tcp://127.0.0.1:0") as (url,):
            client = await connect(url, COUNT)
            kept.append(client)
            assert await client.call(2) == "counted to 2"

    anyio.run(forgets, backend=anyio_backend)
    kept.clear()
    gc.collect()
    assert capfd.readouterr().err == ""


def test_a_client_that_outlives_its_event_loop_is_collected_quietly() -> None:
    async def closes_nothing() -> object:
        return await connect(InProcessTransport(), COUNT)

    client: Any = anyio.run(closes_nothing)
    assert isinstance(client, ActionClient)
    del client
    gc.collect()


async def test_it_knows_the_workers_of_a_fleet() -> None:
    connection = await connect(OneWorker())
    assert await connection.workers() == [WORKER]
    assert connection.release == __version__
    await connection.aclose()


async def test_a_connection_that_cannot_be_opened_is_told_at_once() -> None:
    with pytest.raises(ServerNotFound):
        await connect("tcp://127.0.0.1:1", COUNT, reconnect=False)
