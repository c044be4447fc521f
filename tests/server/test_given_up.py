"""A goal that was given up runs again at its server, which keeps running."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import AsyncGenerator
from contextlib import closing
from pathlib import Path

import anyio
import pytest

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalStatus,
    ServerFailed,
    SqliteStore,
    StoreError,
)
from fibaction.border.goal_store import StoredGoal
from fibaction.stores._journal_file import JournalFile
from fibaction.stores._writer import SqliteJournal
from fibaction.stores.journal_rows import WholeRecord, encode_row
from fibaction.words.goals import UNKNOWN_SENDER, digest_of

pytestmark = pytest.mark.anyio

PAINT = Action("paint", goal=int, feedback=int, result=str, checkpoint=int)
OLD_ID = GoalID(bytes(range(16)))


async def paint(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    yield f"{goal.request} from {goal.restored}"


@pytest.fixture
def server(tmp_path: Path) -> ActionServer[int, int, str]:
    """A server whose store has a goal that was given up at its checkpoint 4."""
    return given_up_at(tmp_path, b"\x04")


def given_up_at(tmp_path: Path, checkpoint: bytes | None) -> ActionServer[int, int, str]:
    path = tmp_path / "goals.db"
    goal = PAINT.goal.encode(9)
    old = StoredGoal(OLD_ID, 1, UNKNOWN_SENDER, digest_of(goal), goal, checkpoint=checkpoint)
    old.status, old.reason, old.ended_at = GoalStatus.ABORTED, "lost", time.time_ns()
    with closing(JournalFile(str(path), "full")) as file:
        file.add(encode_row(file.next_number, [WholeRecord("paint", old)]))
    return ActionServer(PAINT, paint, store=SqliteStore(path))


async def test_it_runs_once_as_a_new_goal_from_its_last_checkpoint(
    server: ActionServer[int, int, str],
) -> None:
    with anyio.fail_after(30):
        async with server:
            new = await server.rerun(OLD_ID)
            assert new is not None
            assert await server.rerun(OLD_ID) is None
            await anyio.wait_all_tasks_blocked()
            outcome = await (await ActionClient(server, PAINT).attach(new)).outcome()
            assert outcome.result == "9 from 4"
            assert (await server.get_result(OLD_ID)).reason == "lost"


@pytest.mark.parametrize("after", [None, 0])
@pytest.mark.parametrize("is_forgotten", [False, True])
async def test_who_follows_it_is_told_its_checkpoint_until_it_runs_again(
    server: ActionServer[int, int, str], after: int | None, is_forgotten: bool
) -> None:
    with anyio.fail_after(30):
        async with server:
            if is_forgotten:
                server._parts.registry.expire(math.inf)
            stream = await server.feedback(OLD_ID, after=after)
            assert stream.checkpoint == b"\x04"
            assert (await stream.outcome()).reason == "lost"
            if after == 0 or is_forgotten:
                assert stream.goal == PAINT.goal.encode(9)
            assert await server.rerun(OLD_ID) is not None
            if not is_forgotten:
                assert (await server.feedback(OLD_ID, after=after)).checkpoint is None


async def test_of_a_server_that_holds_too_many_bytes_its_reason_is_told_without_its_checkpoint(
    server: ActionServer[int, int, str],
) -> None:
    with anyio.fail_after(30):
        async with server:
            budget = server._parts.registry.budget
            budget.used += budget.limit + 1
            stream = await server.feedback(OLD_ID)
            assert stream.checkpoint is None
            assert (await stream.outcome()).reason == "lost"
            budget.used -= budget.limit + 1


async def test_one_that_has_made_no_checkpoint_is_told_apart_from_any_other_goal(
    tmp_path: Path,
) -> None:
    async with given_up_at(tmp_path, None) as server:
        assert (await server.feedback(OLD_ID)).checkpoint == b""
        goal = await ActionClient(server, PAINT).send_goal(1)
        await goal.outcome()
        assert (await server.feedback(goal.goal_id)).checkpoint is None


async def test_the_bytes_that_followers_get_of_it_count_as_long_as_it_is_followed(
    server: ActionServer[int, int, str],
) -> None:
    async with server:
        budget = server._parts.registry.budget
        before = budget.used
        streams = [await server.feedback(OLD_ID, after=after) for after in (None, 0)]
        # The checkpoint twice, and the goal for the one that reads it from its beginning.
        assert budget.used - before == 2 * len(b"\x04") + len(PAINT.goal.encode(9))
        budget.limit = budget.used - 1
        told = await server.feedback(OLD_ID, after=0)
        assert (told.checkpoint, told.goal) == (None, None)
        assert (await told.outcome()).reason == "lost"
        streams.clear()
        gc.collect()
        assert budget.used == before


async def test_a_store_that_cannot_be_read_tells_the_end_without_the_checkpoint(
    server: ActionServer[int, int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise StoreError("a secret place is gone")

    monkeypatch.setattr(SqliteJournal, "given_up", fail)
    async with server:
        assert (await server.feedback(OLD_ID)).checkpoint is None
        server._parts.registry.expire(math.inf)
        with pytest.raises(ServerFailed, match=r"^the server cannot read the history"):
            await server.feedback(OLD_ID)


async def test_a_server_without_a_store_has_given_up_none() -> None:
    async with ActionServer(PAINT, paint) as server:
        assert await server.rerun(OLD_ID) is None


async def test_a_store_that_cannot_keep_it_fails_the_request(
    server: ActionServer[int, int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object) -> None:
        raise StoreError("a secret place is full")

    monkeypatch.setattr(SqliteJournal, "rerun", fail)
    async with server:
        with pytest.raises(ServerFailed, match=r"^the server cannot keep that the goal runs again"):
            await server.rerun(OLD_ID)
