"""`fibaction.server.intake`: an operator pauses, resumes and drains a server."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import anyio
import msgspec
import pytest
from anyio.abc import TaskGroup

from fibaction import (
    Action,
    ActionClient,
    ActionServer,
    GoalHandle,
    GoalKept,
    GoalRejected,
    GoalStatus,
    RejectionCode,
    Schedule,
    ServerFailed,
    SqliteStore,
    StoreError,
    TransportError,
)
from fibaction.border.goal_store import IntakeSource
from fibaction.stores._writer import SqliteJournal
from fibaction.words.intake import MOST_CHANGES, Intake, IntakeChange, IntakeMode, ScheduleInfo
from tests.server.held import fails

pytestmark = pytest.mark.anyio

DRIVE = Action("drive", goal=int, feedback=int, result=str)
HOLD, OPEN, REFUSE, DRAIN = (
    IntakeChange(mode, "wet floor", "ann")
    for mode in (IntakeMode.HOLD, IntakeMode.OPEN, IntakeMode.REFUSE, IntakeMode.DRAIN)
)


class Driver:
    """Goals that run until they may end."""

    def __init__(self, **settings: Any) -> None:
        self.go_on = anyio.Event()
        self.begun: list[int] = []
        self.server = ActionServer(DRIVE, self._drive, **settings)
        self.client = ActionClient(self.server, DRIVE)

    async def _drive(self, goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        self.begun.append(goal.request)
        yield 1
        await self.go_on.wait()
        yield "there"

    async def statuses(self) -> list[GoalStatus]:
        await anyio.wait_all_tasks_blocked()
        return [info.status for info in await self.client.goals()]


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.mark.parametrize("schedule", [None, Schedule(concurrency=2, queue=9)])
async def test_goals_wait_during_a_pause_and_those_that_run_run_on(schedule: Any) -> None:
    driver = Driver(schedule=schedule)
    with anyio.fail_after(20):
        async with driver.server as server:
            first = await driver.client.send_goal(1)
            await anext(first.feedback)
            assert (await server.change_intake(HOLD)).mode is IntakeMode.HOLD
            others = [await driver.client.send_goal(number) for number in (2, 3)]
            assert await driver.statuses() == [GoalStatus.EXECUTING] + [GoalStatus.ACCEPTED] * 2
            await others[0].cancel()
            driver.go_on.set()
            assert await first.result() == "there"
            assert driver.begun == [1]
            assert (await others[0].outcome()).status is GoalStatus.CANCELED
            await server.change_intake(OPEN)
            assert await others[1].result() == "there"
    assert driver.begun == [1, 3]


async def test_goals_that_waited_begin_until_the_next_pause() -> None:
    driver = Driver()
    with anyio.fail_after(20):
        async with driver.server as server:
            await server.change_intake(HOLD)
            for number in range(3):
                await driver.client.send_goal(number)
            runs = server._parts.runs
            begin = runs.begin
            rule = server._parts.levers._rule

            def begin_one(goal_id: Any) -> None:
                begin(goal_id)
                rule.holds = True

            runs.begin = begin_one  # type: ignore[method-assign]  # another pause, in the middle
            await server.change_intake(OPEN)
            assert (await driver.statuses()).count(GoalStatus.EXECUTING) == 1
            rule.holds, runs.begin = False, begin  # type: ignore[method-assign]  # as it was
            await runs.follow_intake()
            assert (await driver.statuses()).count(GoalStatus.EXECUTING) == 3


async def test_a_goal_is_rejected_as_busy_if_the_operator_wants_that(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver = Driver()
    async with driver.server as server:
        with caplog.at_level(logging.WARNING, "fibaction.server"):
            intake = await server.change_intake(REFUSE)
        with pytest.raises(GoalRejected, match=r"paused since \S+: wet floor") as rejected:
            await driver.client.send_goal(1)
        assert rejected.value.code is RejectionCode.BUSY
        assert intake == await server.intake()
        await server.change_intake(OPEN)
        await driver.client.send_goal(1)
    assert caplog.messages == [
        f"action 'drive' {what} (by ann): wet floor"
        for what in ("is paused, and new goals are rejected", "takes goals again")
    ]


@pytest.mark.parametrize("is_late", [False, True])
async def test_a_drain_lets_steps_of_running_goals_in_until_it_ends(is_late: bool) -> None:
    missions = Driver()
    waits, goes_on = anyio.Event(), anyio.Event()

    async def decide(_goal: int) -> None:
        waits.set()
        await goes_on.wait()

    driver = Driver(on_goal=decide) if is_late else Driver()
    with anyio.fail_after(20):
        async with missions.server as server, driver.server:
            mission = await missions.client.send_goal(1)
            await anext(mission.feedback)
            handle = server._parts.runs.handle_of(mission.goal_id)

            async with anyio.create_task_group() as tasks:
                if is_late:
                    tasks.start_soon(
                        fails, GoalRejected, "server drains", driver.client.send_goal, 9
                    )
                    await waits.wait()
                for one in (server, driver.server):
                    for _ in range(2):
                        intake = await one.change_intake(DRAIN)
                    assert (intake.mode, len(intake.changes)) == (IntakeMode.DRAIN, 1)
                goes_on.set()
            async with driver.client.send_goal(2, step=handle.step("drive")) as step:
                with pytest.raises(GoalRejected, match="the server drains") as rejected:
                    await driver.client.send_goal(3)
                assert rejected.value.code is RejectionCode.BUSY
                missions.go_on.set()
                driver.go_on.set()
                assert await step.result() == "there"
            ended = await driver.server.change_intake(OPEN)
            assert (ended.mode, len(ended.changes)) == (IntakeMode.OPEN, 2)
            assert await driver.client.call(4) == "there"


async def test_a_pause_outlives_the_server_with_its_store_and_a_drain_does_not(
    tmp_path: Path,
) -> None:
    store = SqliteStore(tmp_path / "goals.db")
    with anyio.fail_after(20):
        async with Driver(store=store).server as server:
            await server.change_intake(HOLD)
            await server.change_intake(DRAIN)
        driver = Driver(store=store, at_stop="keep")
        async with driver.server as server:
            intake = await server.intake()
            assert (intake.mode, len(intake.changes)) == (IntakeMode.HOLD, 2)
            goal = await driver.client.send_goal(1)
            assert await driver.statuses() == [GoalStatus.ACCEPTED]
        driver = Driver(store=store)
        driver.go_on.set()
        async with driver.server as server:
            assert await driver.statuses() == [GoalStatus.ACCEPTED]
            await server.change_intake(OPEN)
            assert await (await driver.client.attach(goal.goal_id)).result() == "there"


async def test_a_suspect_and_what_waits_for_it_begin_in_their_turn_after_a_pause() -> None:
    driver = Driver()
    with anyio.fail_after(20):
        async with driver.server as server:
            runs = server._parts.runs
            await server.change_intake(HOLD)
            goal = await driver.client.send_goal(1)
            suspect: Any = object()
            runs.suspects.add(suspect, runs)
            await server.change_intake(OPEN)
            assert await driver.statuses() == [GoalStatus.ACCEPTED]
            runs.suspects._discard(suspect)
            driver.go_on.set()
            assert await goal.result() == "there"


async def test_a_server_with_a_shared_store_looks_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SqliteJournal, "intake_period", 0.01)
    with anyio.fail_after(20):
        async with Driver(store=SqliteStore(tmp_path / "goals.db")).server as server:
            paused = msgspec.msgpack.encode(Intake(IntakeMode.REFUSE))
            await server._parts.keeper.intakes.change_intake(lambda _: paused)
            while not server._parts.registry.intake.busy:
                await anyio.lowlevel.checkpoint()


class Shared(IntakeSource):
    """A source that another server of the store changes, and that can fail."""

    intake_period = 0.0

    def __init__(self) -> None:
        self.error: StoreError | None = None

    async def intake(self) -> bytes:
        if self.error is not None:
            raise self.error
        return self._intake

    async def change_intake(self, change: Any) -> bytes:
        await self.intake()
        return await super().change_intake(change)


async def test_a_pause_by_another_server_of_the_store_is_noticed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver = Driver()
    with anyio.fail_after(20):
        async with driver.server as server:
            source = server._parts.keeper.intakes = Shared()
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(server._parts.levers.watch)
                other = Driver()
                async with other.server as second:
                    second._parts.keeper.intakes = source
                    await second.change_intake(REFUSE)
                while not server._parts.levers._rule.busy:
                    await anyio.lowlevel.checkpoint()
                source.error = StoreError("the broker is away")
                for _ in range(10):
                    await anyio.lowlevel.checkpoint()
                tasks.cancel_scope.cancel()
            for call in (server.intake(), server.change_intake(OPEN)):
                with pytest.raises(ServerFailed, match="cannot keep or read how it takes goals"):
                    await call
            with pytest.raises(GoalRejected, match="paused"):
                await driver.client.send_goal(1)
            source.error = None
            source._intake = b"\xc1"
            assert (await server.intake()).mode is IntakeMode.OPEN
            assert "its intake cannot be read, and is open" in caplog.text
            with pytest.raises(TransportError, match="has no workers"):
                await server.change_intake(IntakeChange(IntakeMode.DRAIN, worker="a"))


async def test_a_drain_that_the_server_itself_has_begun_is_not_ended_by_an_operator() -> None:
    driver = Driver()
    async with driver.server as server:
        await server.change_intake(DRAIN)
        await server.drain(timeout=0)
        assert (await server.change_intake(OPEN)).mode is IntakeMode.DRAIN
        with pytest.raises(GoalRejected, match="the server drains"):
            await driver.client.send_goal(1)


async def test_a_goal_that_is_decided_on_when_a_pause_begins_is_rejected() -> None:
    asked, decide = anyio.Event(), anyio.Event()

    async def on_goal(request: int) -> None:
        asked.set()
        await decide.wait()

    driver = Driver(on_goal=on_goal)
    with anyio.fail_after(20):
        async with driver.server as server, anyio.create_task_group() as tasks:
            tasks.start_soon(fails, GoalRejected, "wet floor", driver.client.send_goal, 1)
            await asked.wait()
            await server.change_intake(REFUSE)
            decide.set()


async def test_changes_that_are_only_noted_count_in_the_bound_of_those_that_are_kept() -> None:
    driver = Driver()
    async with driver.server as server:
        for _ in range(MOST_CHANGES):
            await server.change_intake(DRAIN)
            await server.change_intake(OPEN)
        assert len((await server.intake()).changes) == MOST_CHANGES


class SlowSource(IntakeSource):
    """A source that keeps a change, and tells that later."""

    def __init__(self) -> None:
        self.kept, self.tell = anyio.Event(), anyio.Event()

    async def change_intake(self, change: Any) -> bytes:
        kept = await super().change_intake(change)
        self.kept.set()
        await self.tell.wait()
        return kept


@pytest.mark.parametrize("change", [REFUSE, DRAIN])
async def test_a_change_that_is_kept_is_followed_although_its_operator_has_left(
    change: IntakeChange,
) -> None:
    driver = Driver()
    with anyio.fail_after(20):
        async with driver.server as server:
            source = server._parts.keeper.intakes = SlowSource()
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(server.change_intake, change)
                await source.kept.wait()
                tasks.cancel_scope.cancel()
                source.tell.set()
            with pytest.raises(GoalRejected, match=r"paused|drains"):
                await driver.client.send_goal(1)


async def draining(server: ActionServer[Any, Any, Any], tasks: TaskGroup) -> anyio.Event:
    """Drain a server until it waits, and return the event that tells that it has drained."""
    is_drained = anyio.Event()

    async def drain() -> None:
        await server.drain(timeout=600)
        is_drained.set()

    tasks.start_soon(drain)
    await anyio.wait_all_tasks_blocked()
    return is_drained


@pytest.mark.parametrize("at_stop", ["abort", "keep", None])
@pytest.mark.parametrize("pauses_late", [False, True])
async def test_a_drain_waits_for_no_goal_that_a_pause_keeps_from_beginning(
    tmp_path: Path, at_stop: Any, pauses_late: bool
) -> None:
    kept: Any = {"store": SqliteStore(tmp_path / "goals.db"), "at_stop": at_stop} if at_stop else {}
    driver = Driver(schedule=Schedule(concurrency=1, queue=9), **kept)
    with anyio.fail_after(20):
        async with driver.server as server, anyio.create_task_group() as tasks:
            first = await driver.client.send_goal(1)
            await anext(first.feedback)
            goals = [await driver.client.send_goal(number) for number in (2, 3)]
            if not pauses_late:
                await server.change_intake(HOLD)
            is_drained = await draining(server, tasks)
            assert not is_drained.is_set()
            if pauses_late:
                await server.change_intake(HOLD)
            driver.go_on.set()
            assert await first.result() == "there"
            await is_drained.wait()
            assert await driver.statuses() == [GoalStatus.SUCCEEDED] + [GoalStatus.ACCEPTED] * 2
            await server.stop()
            for goal in goals:
                if at_stop == "keep":
                    with pytest.raises(GoalKept):
                        await goal.outcome()
                else:
                    assert (await goal.outcome()).reason == "server stopped"


async def test_a_pause_ends_a_drain_that_waits_for_goals_that_have_not_begun_only() -> None:
    driver = Driver()
    with anyio.fail_after(20):
        async with driver.server as server, anyio.create_task_group() as tasks:
            suspect: Any = object()
            server._parts.runs.suspects.add(suspect, server._parts.runs)
            await driver.client.send_goal(1)
            is_drained = await draining(server, tasks)
            assert not is_drained.is_set()
            await server.change_intake(HOLD)
            await is_drained.wait()
            server._parts.runs.suspects._discard(suspect)


@pytest.mark.parametrize(
    ("schedule", "told"),
    [
        (None, ScheduleInfo(max_goals=7)),
        (
            Schedule(concurrency=2, queue=9, key=lambda goal: goal, priority=lambda goal: goal),
            ScheduleInfo(7, 2, None, 9, is_keyed=True, has_priority=True),
        ),
        (
            Schedule(total=10**30, queue=1, queue_timeout=5, run_timeout=60, when_full="replace"),
            ScheduleInfo(7, None, 2**31 - 1, 1, False, False, "replace", 5.0, 60.0),
        ),
    ],
)
async def test_a_server_tells_its_limits_which_a_store_does_not_keep(
    schedule: Schedule | None, told: ScheduleInfo
) -> None:
    driver = Driver(schedule=schedule, max_goals=7)
    async with driver.server as server:
        for intake in (await server.intake(), await server.change_intake(HOLD)):
            assert intake.schedule == told
            assert intake.has_levers
        kept = await server._parts.keeper.intakes.intake()
        assert msgspec.msgpack.decode(kept, type=Intake).schedule is None
