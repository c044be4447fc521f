"""Goals that a server has forgotten, and that its store has in its history."""

from __future__ import annotations

import gc
import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import anyio.lowlevel
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    GoalID,
    GoalInfo,
    GoalStatus,
    LimitReached,
    ServerFailed,
    SqliteStore,
    StoreError,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint
from fibaction.words.goal_query import GoalQuery, PastPage
from tests.support.matching import End

pytestmark = pytest.mark.anyio

PAINT = Action("paint", goal=int, feedback=int, result=str)
PAINTED = End(GoalStatus.SUCCEEDED, "painted 3 times")


async def paint(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.request == 0:
        raise GoalAborted("nothing to paint")
    for number in range(goal.request):
        yield number
    yield f"painted {goal.request} times"


@asynccontextmanager
async def painting(path: Path) -> AsyncGenerator[ActionServer[int, int, str], None]:
    """Run a server that forgets each goal at its end, and has a history."""
    store = SqliteStore(path / "goals.db", history=GoalHistory())
    with anyio.fail_after(30):
        async with ActionServer(PAINT, paint, store=store, result_timeout=0) as server:
            yield server


async def ran(client: ActionClient[int, int, str], request: int) -> GoalID:
    goal = await client.send_goal(request)
    await goal.outcome()
    return goal.goal_id


async def test_a_goal_that_is_forgotten_is_listed_and_has_its_result(tmp_path: Path) -> None:
    async with painting(tmp_path) as server:
        client = ActionClient(server, PAINT)
        goal_ids = [await ran(client, request) for request in (3, 0)]
        assert await client.goals() == []
        infos = await server.past_goals(PastPage())
        aborted = GoalQuery(frozenset([GoalStatus.ABORTED]))
        [failed] = await server.past_goals(PastPage(aborted))
        assert [info.goal_id for info in infos] == goal_ids[::-1]
        assert (failed.goal_id, failed.reason) == (goal_ids[1], "nothing to paint")
        goal = await client.attach(goal_ids[0])
        assert [feedback async for feedback in goal.feedback] == []
        assert await goal.outcome() == PAINTED
        assert (await server.feedback(goal_ids[0])).goal == PAINT.goal.encode(3)


async def test_a_goal_that_is_remembered_is_told_with_what_was_sent(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "goals.db", history=GoalHistory())
    with anyio.fail_after(30):
        async with ActionServer(PAINT, paint, store=store, result_timeout=60) as server:
            goal_id = await ran(ActionClient(server, PAINT), 3)
            stream = await server.feedback(goal_id, after=1)
            assert stream.goal == PAINT.goal.encode(3)
            assert len(stream.take(5)) == 2
        async with ActionServer(PAINT, paint, store=store, result_timeout=60) as server:
            assert (await server.feedback(goal_id, after=1)).goal == PAINT.goal.encode(3)
            assert (await server.feedback(goal_id)).goal is None  # who wants the result only


async def test_the_feedback_of_a_goal_of_the_past_counts_as_dropped(tmp_path: Path) -> None:
    async with painting(tmp_path) as server:
        goal_id = await ran(client := ActionClient(server, PAINT), 3)
        goal = await client.attach(goal_id, after=1)
        assert [feedback async for feedback in goal.feedback] == []
        assert goal.feedback.dropped == 2


async def test_the_endpoints_of_a_server_have_its_history(tmp_path: Path) -> None:
    async with painting(tmp_path) as server, serve(server, "inproc://past"):
        await ran(ActionClient(server, PAINT), 3)
        infos = await server.past_goals(PastPage())
        assert len(infos) == 1
        async with connect("inproc://past", PAINT) as client:
            for endpoint in (client.endpoint, ForwardingEndpoint(server)):
                assert await endpoint.past_goals(PastPage()) == infos
                read: list[GoalInfo] = []
                await endpoint.read_past(GoalQuery(), read.extend)
                assert read == infos


async def test_goals_of_the_past_are_read_as_far_as_there_is_room_for_their_bytes(
    tmp_path: Path,
) -> None:
    async with painting(tmp_path) as server:
        goal_id = await ran(client := ActionClient(server, PAINT), 3)
        assert await client.goals() == []
        budget = server._parts.past._budget
        while budget.used:  # its executor and the thread of the store are done with it soon
            await server.past_goals(PastPage())
            gc.collect()
        goal = await client.attach(goal_id)
        assert budget.used > 0
        budget.limit = 0
        with pytest.raises(LimitReached, match="too many bytes"):
            await client.attach(goal_id)
        assert await goal.outcome() == PAINTED
        del goal
        gc.collect()
        assert budget.used == 0
        await client.attach(goal_id)


async def test_a_history_that_cannot_be_read_is_told_and_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def fail(_asked: object) -> None:
        raise StoreError("cannot keep goals in a secret place")

    async with painting(tmp_path) as server:
        past = server._parts.keeper.past
        monkeypatch.setattr(past, "past_goals", fail)
        monkeypatch.setattr(past, "past_goal", fail)
        with caplog.at_level(logging.ERROR, "fibaction.server"):
            with pytest.raises(ServerFailed, match=r"^the server cannot read the history"):
                await server.past_goals(PastPage())
            with pytest.raises(ServerFailed, match=r"^the server cannot read the history"):
                await server.read_past(GoalQuery(), print)
            with pytest.raises(ServerFailed, match=r"^the server cannot read the history"):
                await server.feedback(GoalID.random())
        assert await ran(ActionClient(server, PAINT), 1)
    assert [record.message.split(": ")[1] for record in caplog.records] == [
        "cannot keep goals in a secret place"
    ] * 3
