"""`fibaction.server.life`: the table of a goal's life, alone and beside servers that follow it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any
from unittest.mock import patch

import anyio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from trio.testing import MockClock

from fibaction import Action, ActionServer, GoalHandle, GoalID, GoalStatus, Schedule
from fibaction.server.life import (
    KEPT,
    LIFE,
    LIFE_IN_MEMORY,
    Effect,
    Event,
    InvalidStep,
    Life,
    Phase,
)
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.errors import ActionError, StoreError
from tests.support.memory_store import Fate, MemoryStore

STEPS = Action("steps", goal=int, feedback=int, result=str)
LEFT = (Phase.ENDED, Phase.RELEASED, Phase.LOST, Phase.REJECTED)
NO_TURN = (Phase.DECIDING, Phase.ACCEPTANCE_IN_WRITING)


STARTED = {GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.CANCELING}
TOLD: dict[Phase, set[GoalStatus]] = dict.fromkeys(Phase, STARTED) | {
    Phase.DECIDING: set(),
    Phase.ACCEPTANCE_IN_WRITING: set(),
    Phase.REJECTED: set(),
    Phase.RUNNING_AHEAD: {GoalStatus.ACCEPTED},
    Phase.RUNNING: {GoalStatus.EXECUTING, GoalStatus.CANCELING},
    Phase.ENDED: {GoalStatus.SUCCEEDED, GoalStatus.CANCELED, GoalStatus.ABORTED},
}
"""The statuses that clients may have been told, for each phase. Which of them it is depends on the
writes that the store has answered. A goal that waits has more than ACCEPTED only if an earlier
attempt was told."""


# The table alone


def test_without_a_store_nothing_is_written_and_the_same_is_told() -> None:
    assert LIFE_IN_MEMORY.keys() == LIFE.keys()
    for at, step in LIFE_IN_MEMORY.items():
        assert not KEPT.keys() & set(step.effects)
        assert step.effects[-1:] == LIFE[at].effects[-1:] or LIFE[at].effects[-1] in KEPT
    for begun, effects in (
        (Event.BEGIN, (Effect.CALL,)),
        (Event.TAKE_OVER, (Effect.RUN_AHEAD, Effect.TELL_TAKE_OVER)),
        (Event.CANCEL, (Effect.TELL_CANCELING, Effect.END_AND_LEAVE)),
        (Event.END, (Effect.REMOVE, Effect.TELL_END)),
        (Event.RELEASE, (Effect.REMOVE, Effect.TELL_GONE)),
    ):
        assert LIFE_IN_MEMORY[Phase.WAITING, begun].effects == effects


def test_an_event_that_a_phase_does_not_allow_is_a_bug() -> None:
    with pytest.raises(InvalidStep, match="END cannot happen to a goal in the phase ENDED"):
        LIFE[Phase.ENDED, Event.END]


def test_a_goal_never_goes_back_and_stays_where_it_has_left() -> None:
    for (before, _), (after, _) in LIFE.items():
        assert after >= before
        assert not (before in LEFT and after is not before and after is not Phase.LOST)
        assert before.is_open or not after.is_open


def test_every_phase_is_reached_and_can_be_left_unless_the_goal_has_gone() -> None:
    reached = {Phase.DECIDING} | {step.phase for step in LIFE.values()}
    assert reached == set(Phase)
    for phase in Phase:
        leads_on = any(one is phase and to.phase is not phase for (one, _), to in LIFE.items())
        assert leads_on or phase is Phase.LOST


def test_an_open_goal_can_always_be_ended_lost_and_let_go() -> None:
    for phase in Phase:
        if phase.is_open and phase not in NO_TURN:
            assert LIFE[phase, Event.END].phase is Phase.END_IN_WRITING
            assert LIFE[phase, Event.RELEASE].phase is Phase.RELEASE_IN_WRITING
            assert LIFE[phase, Event.LOSE].phase is Phase.LOST
            assert LIFE[phase, Event.RELEASE_UNWRITTEN].phase is Phase.RELEASED


def test_what_is_fixed_is_not_changed_by_a_cancel_or_a_stop() -> None:
    for phase in Phase:
        if not phase.is_open:
            for event in (Event.CANCEL, Event.CANCEL_GENTLY, Event.STOP, Event.END):
                assert (phase, event) not in LIFE


# Beside a server


class Walk:
    """A server with a schedule of one place, and a record of the steps of its goals."""

    def __init__(self, store: MemoryStore | None, at_stop: Any) -> None:
        self.store = store
        self.doors: dict[int, anyio.Event] = {}
        self.steps: set[tuple[Phase, Event]] = set()
        self.server = ActionServer(
            STEPS,
            self.execute,
            store=store,
            at_stop=at_stop,
            recovery="rerun",
            shutdown_timeout=1,
            schedule=Schedule(concurrency=1, queue=2),
        )

    async def execute(self, goal: GoalHandle[int]) -> AsyncIterator[int | str]:
        yield goal.request
        await self.doors.setdefault(goal.request, anyio.Event()).wait()
        yield "done"

    def check(self, goal: GoalRecord) -> None:
        """Check that the status that clients are told is one of the phase."""
        if TOLD[goal.phase]:  # else clients are told nothing yet, or nothing at all
            assert goal.told_status in TOLD[goal.phase], (goal.phase, goal.told_status)
        assert goal.told_status <= goal.status or goal.status.is_terminal

    async def walk(self, acts: list[tuple[str, int]]) -> None:
        real = Life.step

        def step(life: Life, living: Any, event: Event) -> None:
            before = living.goal.phase
            real(life, living, event)
            self.steps.add((before, event))
            self.check(living.goal)

        with patch.object(Life, "step", step):
            try:
                async with self.server, anyio.create_task_group() as tasks:
                    for act, number in acts:
                        tasks.start_soon(self._act, act, number)
                        await anyio.sleep(1)
                    if self.store is not None:
                        self.store.release()
                    tasks.cancel_scope.cancel()
            except StoreError:
                assert self.store is not None
        assert self.steps <= set(LIFE if self.store is not None else LIFE_IN_MEMORY)

    async def _act(self, act: str, number: int) -> None:
        goal_id = GoalID(number.to_bytes(16, "big"))
        try:
            if act == "send":
                stream = await self.server.send_goal(goal_id, STEPS.goal.encode(number))
                await stream.outcome()
            elif act == "cancel":
                await self.server.cancel_goals(goal_id)
            elif act == "end":
                self.doors.setdefault(number, anyio.Event()).set()
            elif self.store is not None:
                self.store.take("steps", goal_id) if act == "lose" else self._hold()
        except ActionError:
            pass  # whatever the client is told, the walk goes on

    def _hold(self) -> None:
        assert self.store is not None
        if self.store.is_holding:
            self.store.release()
        else:
            self.store.hold()


AN_ACT = st.tuples(
    st.sampled_from(["send", "send", "send", "cancel", "end", "lose", "hold"]),
    st.integers(1, 4),
)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    acts=st.lists(AN_ACT, max_size=12),
    kind=st.sampled_from(["memory", "store", "slow", "fails"]),
    at_stop=st.sampled_from(["abort", "keep"]),
    fails_at=st.integers(1, 12),
)
def test_a_server_takes_only_steps_of_the_table_and_tells_the_statuses_of_the_phase(
    acts: list[tuple[str, int]], kind: str, at_stop: str, fails_at: int
) -> None:
    store: MemoryStore | None = None
    if kind == "memory":
        at_stop = "abort"
    else:
        store = MemoryStore(
            lambda number, _: Fate.FAILED if kind == "fails" and number >= fails_at else Fate.KEPT
        )
        if kind == "slow":
            store.delay = lambda: 1.5
    options = {"clock": MockClock(autojump_threshold=0)}
    anyio.run(Walk(store, at_stop).walk, acts, backend="trio", backend_options=options)
