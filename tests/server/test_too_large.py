"""What is too large for a store: a goal, a checkpoint or a result, each by itself."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle, GoalID, GoalStatus, Schedule
from fibaction.border.goal_store import RecordTooLarge, StoredGoal, StoreFull, Then
from fibaction.words.errors import GoalAborted, GoalRejected, RejectionCode
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from tests.support.memory_store import MemoryJournal, MemoryStore
from tests.support.virtual_time import in_virtual_time

pytestmark = [pytest.mark.anyio, in_virtual_time()]
LIMIT = 100
ECHO = Action("echo", goal=str, feedback=int, result=str, checkpoint=str)


async def echo(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
    """Keep a checkpoint, or return a result, of the size in the goal."""
    what, _, size = goal.request.partition(" ")
    if what == "checkpoint":
        try:
            await goal.checkpoint("x" * int(size))
        except RecordTooLarge as exc:
            await goal.checkpoint("small")
            yield f"{exc}"
            return
    yield "x" * int(size or 0) if what == "result" else goal.request[:5]


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> MemoryStore:
    """A store that takes records of so many bytes."""
    write = MemoryJournal._write

    def limited(self: MemoryJournal, what: str, goal: StoredGoal, then: Then) -> None:
        sizes = (goal.goal, goal.checkpoint or b"", goal.result or b"")
        if sum(map(len, sizes)) <= LIMIT:
            write(self, what, goal, then)
        else:
            then(RecordTooLarge(f"it has more than {LIMIT} bytes"))

    monkeypatch.setattr(MemoryJournal, "_write", limited)
    return MemoryStore()


def server_with(store: MemoryStore, **settings: Any) -> ActionServer[str, int, str]:
    return ActionServer(ECHO, echo, store=store, **settings)


@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=1)])
async def test_a_goal_is_rejected_with_the_reason(
    store: MemoryStore, schedule: Schedule | None
) -> None:
    async with server_with(store, schedule=schedule) as server:
        client = ActionClient(server, ECHO)
        with pytest.raises(GoalRejected) as caught:
            await client.call("x" * 200)
        assert caught.value.reason == "the goal cannot be kept: it has more than 100 bytes"
        assert await client.call("hello") == "hello"
    assert len(store.goals) == 1


async def test_a_goal_for_which_a_store_has_no_room_now_is_rejected_as_busy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(self: MemoryJournal, what: str, goal: StoredGoal, then: Then) -> None:
        then(StoreFull("the brokers have no room"))

    monkeypatch.setattr(MemoryJournal, "_write", full)
    async with server_with(MemoryStore()) as server:
        with pytest.raises(GoalRejected, match="busy: the brokers have no room") as caught:
            await ActionClient(server, ECHO).call("hello")
    assert caught.value.code is RejectionCode.BUSY


async def test_a_checkpoint_is_an_error_at_the_await_and_the_goal_goes_on(
    store: MemoryStore,
) -> None:
    async with server_with(store) as server:
        client = ActionClient(server, ECHO)
        assert await client.call("checkpoint 200") == "it has more than 100 bytes"
        assert await client.call("checkpoint 20") == "check"


async def test_a_checkpoint_that_is_too_large_leaves_a_later_one_in_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write, late, written = MemoryJournal._write, list[Callable[[], None]](), list[Any]()
    are_written = anyio.Event()

    def slow(self: MemoryJournal, what: str, goal: StoredGoal, then: Then) -> None:
        if len(goal.checkpoint or b"") > LIMIT:
            late.append(lambda: then(RecordTooLarge("no")))
        elif what == "checkpoint":
            late.append(lambda: write(self, what, goal, then))
        else:
            written.append((what, goal.checkpoint))
            write(self, what, goal, then)

    async def twice(goal: GoalHandle[str]) -> AsyncGenerator[int | str, None]:
        async def large() -> None:
            with pytest.raises(RecordTooLarge):
                await goal.checkpoint("x" * 200)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(large)
            await anyio.wait_all_tasks_blocked()
            tasks.start_soon(goal.checkpoint, "later")
            await anyio.wait_all_tasks_blocked()
            for answer in late:  # they come in the order of the writes
                answer()
            are_written.set()
        with anyio.CancelScope(shield=True):
            await anyio.sleep(1)
        yield ""

    monkeypatch.setattr(MemoryJournal, "_write", slow)
    store = MemoryStore()
    async with ActionServer(ECHO, twice, store=store) as server:
        goal = await ActionClient(server, ECHO).send_goal("x")
        with anyio.fail_after(9):
            await are_written.wait()
        await goal.cancel()
        await goal.outcome()
    assert ECHO.checkpoint is not None
    assert ("cancel", ECHO.checkpoint.encode("later")) in written


async def test_a_result_ends_the_goal_as_aborted_with_the_reason(store: MemoryStore) -> None:
    async with server_with(store) as server:
        client = ActionClient(server, ECHO)
        with pytest.raises(GoalAborted, match="the result is not kept: it has more than 100"):
            await client.call("result 200")
        assert await client.call("result 20") == "x" * 20


async def test_a_goal_that_is_given_up_is_kept_without_itself(store: MemoryStore) -> None:
    payload = ECHO.goal.encode("x" * 200)
    lost = StoredGoal(GoalID.random(), 1, UNKNOWN_SENDER, digest_of(payload), payload)
    lost.is_running, lost.attempt = True, 1
    store.goals["echo", lost.goal_id] = lost
    async with server_with(store) as server:
        outcome = await (await ActionClient(server, ECHO).attach(lost.goal_id)).outcome()
    assert (outcome.status, outcome.reason) == (GoalStatus.ABORTED, "the server was restarted")
    [kept] = store.goals.values()
    assert (kept.status, kept.is_given_up) == (GoalStatus.ABORTED, False)
