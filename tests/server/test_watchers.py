"""Watchers: what they see of each goal, in order, and that they cannot harm one."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from typing import Any, cast

import anyio
import pytest

from fibaction import (
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalID,
    GoalKept,
    GoalRejected,
    Outcome,
    Sender,
    connect,
    serve,
)
from fibaction.border.abc import FeedbackItem, ForwardingEndpoint, Meta
from fibaction.border.watchers import Watcher
from fibaction.server import watchers as server_watchers
from fibaction.types.action import ActionInfo
from fibaction.words.goals import CancelAnswer, GoalInfo
from tests.server.held import waits
from tests.support.executors import Items
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.memory_store import MemoryStore
from tests.support.slices import let_slices_last

pytestmark = pytest.mark.anyio

ORDER: ContextVar[int] = ContextVar("ORDER", default=0)


class Diary(Watcher):
    """Remembers each call in short."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def opened(self, info: ActionInfo) -> None:
        self.lines.append(f"opened {info.name}")

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        assert action == FIBONACCI.name
        order = FIBONACCI.goal.decode(goal).order
        ORDER.set(order)
        self.lines.append(f"offered {order} {dict(meta) or ''}".rstrip())

    def taken_over(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        order = FIBONACCI.goal.decode(goal).order
        ORDER.set(order)
        self.lines.append(f"taken over {order} {dict(meta) or ''}".rstrip())

    def rejected(self, action: str, goal_id: GoalID, reason: str) -> None:
        self.lines.append(f"rejected: {reason}")

    def accepted(self, action: str, info: GoalInfo, goal: bytes) -> None:
        order = FIBONACCI.goal.decode(goal).order
        self.lines.append(f"accepted {order}: {info.status.name} {info.attempt}")

    def changed(self, action: str, info: GoalInfo) -> None:
        self.lines.append(info.status.name)

    def feedback(self, action: str, goal_id: GoalID, item: FeedbackItem) -> None:
        sequence = FIBONACCI.feedback.decode(item.payload).partial_sequence
        self.lines.append(f"feedback {item.number}: {sequence}")

    def canceled(self, action: str, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        self.lines.append(f"canceled: {answer.return_code.name}")

    def ended(self, action: str, info: GoalInfo, outcome: Outcome[bytes]) -> None:
        assert info.status is outcome.status
        self.lines.append(
            f"ended {outcome.status.name} {info.feedback_count} {outcome.reason}".rstrip()
        )

    def left(self, action: str, info: GoalInfo, reason: str) -> None:
        self.lines.append(f"left {info.status.name}")

    def closed(self, info: ActionInfo) -> None:
        self.lines.append(f"closed {info.name}")


async def test_a_watcher_sees_a_goal_from_its_offer_to_its_end() -> None:
    diary = Diary()
    async with ActionServer(FIBONACCI, fibonacci, watchers=[diary]) as server:
        await ActionClient(server, FIBONACCI).call(Goal(3))

    assert diary.lines == [
        "opened fibonacci",
        "offered 3",
        "accepted 3: ACCEPTED 1",
        "EXECUTING",
        "feedback 1: [0, 1, 1]",
        "feedback 2: [0, 1, 1, 2]",
        "ended SUCCEEDED 2",
        "closed fibonacci",
    ]


async def test_a_watcher_sees_cancels_and_aborts_each_with_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    let_slices_last(monkeypatch, 60.0)  # the executor has no turn during the cancel
    diary = Diary()
    async with ActionServer(FIBONACCI, waits, watchers=[diary]) as server:
        client = ActionClient(server, FIBONACCI)
        goal = await client.send_goal(Goal(1))
        await anext(goal.feedback)
        await goal.cancel()
        await goal.outcome()
        await anext((await client.send_goal(Goal(2))).feedback)

    assert diary.lines[4:] == [
        "feedback 1: [1]",
        "CANCELING",
        "canceled: NONE",
        "ended CANCELED 1",
        "offered 2",
        "accepted 2: ACCEPTED 1",
        "EXECUTING",
        "feedback 1: [2]",
        "ended ABORTED 1 server stopped",
        "closed fibonacci",
    ]


@pytest.mark.parametrize("is_async", [False, True])
async def test_a_watcher_sees_each_rejection_once_and_no_retry_of_a_goal(is_async: bool) -> None:
    diary = Diary()

    def rejects(goal: Goal) -> None:
        if goal.order == 7:
            raise GoalRejected("not seven")

    async def rejects_later(goal: Goal) -> None:
        rejects(goal)

    on_goal: Any = rejects_later if is_async else rejects
    async with ActionServer(
        FIBONACCI, waits, on_goal=on_goal, max_goals=1, watchers=[diary]
    ) as server:
        client = ActionClient(server, FIBONACCI)
        with pytest.raises(GoalRejected, match=r"not seven$"):
            await client.send_goal(Goal(7))
        goal_id = GoalID.random()
        for _ in range(2):
            await server.send_goal(goal_id, FIBONACCI.goal.encode(Goal(1)))
        with pytest.raises(GoalRejected, match=r"rejected: busy"):
            await client.send_goal(Goal(2))

    assert [
        line.split(" (")[0] for line in diary.lines if "ejected" in line or "offered" in line
    ] == [
        "offered 7",
        "rejected: not seven",
        "offered 1",
        "offered 2",
        next(line for line in diary.lines if line.startswith("rejected: busy")).split(" (")[0],
    ]


async def test_a_watcher_sees_that_a_call_was_canceled_before_the_decision() -> None:
    diary, asked = Diary(), anyio.Event()

    async def decides(goal: Goal) -> None:
        asked.set()
        await anyio.sleep_forever()

    async with ActionServer(FIBONACCI, waits, on_goal=decides, watchers=[diary]) as server:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(server.send_goal, GoalID.random(), FIBONACCI.goal.encode(Goal(1)))
            await asked.wait()
            tasks.cancel_scope.cancel()

    assert diary.lines[1:3] == ["offered 1", "rejected: the call was canceled before the decision"]


async def test_a_watcher_sees_goals_that_a_store_keeps_and_gives_back() -> None:
    diary, store = Diary(), MemoryStore()
    options: Any = {"store": store, "recovery": "rerun", "at_stop": "keep", "watchers": [diary]}
    payload, meta = FIBONACCI.goal.encode(Goal(4)), {"traceparent": "00-1"}
    async with ActionServer(FIBONACCI, waits, **options) as server:
        stream = await server.send_goal(GoalID.random(), payload, meta=meta)
        await stream.receive()
    with pytest.raises(GoalKept):
        await stream.outcome()
    first, diary.lines = diary.lines, []
    async with ActionServer(FIBONACCI, fibonacci, **options) as server:
        await (await ActionClient(server, FIBONACCI).attach(stream.goal_id)).outcome()

    assert first[1] == "offered 4 {'traceparent': '00-1'}"
    assert first[-3:] == ["feedback 1: [4]", "left EXECUTING", "closed fibonacci"]
    assert diary.lines[:3] == [
        "opened fibonacci",
        "taken over 4 {'traceparent': '00-1'}",
        "accepted 4: EXECUTING 1",
    ]
    assert diary.lines[-2:] == ["ended SUCCEEDED 3", "closed fibonacci"]


async def test_variables_that_a_watcher_sets_are_seen_by_on_goal_and_the_executor_alone() -> None:
    seen: list[int] = []

    async def looks(goal: GoalHandle[Goal]) -> Items:
        seen.append(ORDER.get())
        yield Feedback([])
        seen.append(ORDER.get())
        yield Result([])

    def on_goal(goal: Goal) -> None:
        seen.append(ORDER.get())

    async with ActionServer(FIBONACCI, looks, on_goal=on_goal, watchers=[Diary()]) as server:
        await ActionClient(server, FIBONACCI).call(Goal(5))

    assert seen == [5, 5, 5]
    assert ORDER.get() == 0


async def test_variables_that_a_watcher_sets_are_seen_by_an_executor_that_runs_again() -> None:
    seen: list[int] = []

    async def looks(goal: GoalHandle[Goal]) -> Items:
        seen.append(ORDER.get())
        async for item in waits(goal) if goal.attempt == 1 else fibonacci(goal):
            yield item

    options: Any = {"store": MemoryStore(), "at_stop": "keep", "watchers": [Diary()]}
    async with ActionServer(FIBONACCI, looks, **options) as server:
        goal = await ActionClient(server, FIBONACCI).send_goal(Goal(4))
        await anext(goal.feedback)
    async with ActionServer(FIBONACCI, looks, **options) as server:
        await (await ActionClient(server, FIBONACCI).attach(goal.goal_id)).outcome()

    assert seen == [4, 4]


def fail(self: Watcher, *arguments: Any) -> None:
    raise OSError("disk full")


Broken = type("Broken", (Watcher,), dict.fromkeys(server_watchers.METHODS, fail))


async def test_a_watcher_that_fails_is_logged_once_and_goals_and_other_watchers_go_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    diary = Diary()
    async with ActionServer(FIBONACCI, fibonacci, watchers=[Broken(), diary]) as server:
        result = await ActionClient(server, FIBONACCI).call(Goal(3))

    assert result == Result([0, 1, 1, 2])
    assert diary.lines[-2:] == ["ended SUCCEEDED 2", "closed fibonacci"]
    # On a busy machine, a call may be slow as well, which is a warning.
    (record,) = (one for one in caplog.records if one.levelno >= logging.ERROR)
    assert record.getMessage() == (
        "action 'fibonacci': Broken.opened failed, and goals continue; later errors of it are not"
        " logged: OSError: disk full"
    )


async def test_a_watcher_that_blocks_is_logged_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = iter(range(1000))
    monkeypatch.setattr(server_watchers, "perf_counter", lambda: next(seconds))
    async with ActionServer(FIBONACCI, fibonacci, watchers=[Diary()]) as server:
        await ActionClient(server, FIBONACCI).call(Goal(3))

    (record,) = (one for one in caplog.records if one.levelno >= logging.WARNING)
    assert record.getMessage() == (
        "action 'fibonacci': Diary.opened took 1.0 s, while everything else waited; later slow"
        " calls of it are not logged"
    )


class Waits(Watcher):
    async def closed(self, info: ActionInfo) -> None:  # type: ignore[override]  # wrong on purpose
        """Wait, which a watcher cannot."""


def test_watchers_of_a_wrong_kind_are_rejected_at_once() -> None:
    with pytest.raises(
        TypeError, match=r"^watchers are objects of classes derived from Watcher, not"
    ):
        ActionServer(FIBONACCI, fibonacci, watchers=[cast("Watcher", Diary)])
    with pytest.raises(TypeError, match=r"^Waits\.closed is async, and the server does not wait"):
        ActionServer(FIBONACCI, fibonacci, watchers=[Waits()])


async def test_watchers_of_serve_are_added_to_each_new_server() -> None:
    own, common = Diary(), Diary()
    server = ActionServer(FIBONACCI, fibonacci, watchers=[own])
    async with serve(server, "inproc://watched", watchers=[common]):
        async with connect("inproc://watched", FIBONACCI) as client:
            await client.call(Goal(2))
        with pytest.raises(RuntimeError, match="was started before; give the watchers to another"):
            server.watch_by([Diary()])
        server.watch_by([])  # which adds none

    assert len(own.lines) > 5
    assert own.lines == common.lines
    gateway = ForwardingEndpoint(ActionServer(FIBONACCI, fibonacci))
    with pytest.raises(TypeError, match=r"^only an ActionServer can have watchers, and "):
        async with serve(gateway, "inproc://watched", watchers=[common]):
            pass
