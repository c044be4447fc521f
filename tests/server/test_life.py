"""`fibaction.server.life`: the table of a goal's life."""

from __future__ import annotations

import pytest

from fibaction.server.life import (
    KEPT,
    LIFE,
    LIFE_IN_MEMORY,
    Effect,
    Event,
    InvalidStep,
    Phase,
)

LEFT = (Phase.ENDED, Phase.RELEASED, Phase.LOST, Phase.REJECTED)
NO_TURN = (Phase.DECIDING, Phase.ACCEPTANCE_IN_WRITING)


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
