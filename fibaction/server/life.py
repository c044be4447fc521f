"""The life of a goal at its server, as one table.

Theory of operation
-------------------

The record of a goal is in one `Phase` at a time. What happens to the goal is an `Event`, and
`LIFE` says for each phase which events may happen, which phase comes next, and which `Effect`s are
to be carried out, in their order. An event that may happen but changes nothing has a row, too; any
other one is a bug, and raises `InvalidStep`. `Life` is the interpreter of the table, the only one:
each part of a server gives it functions for effects. The table does not wait, write, or depend on
executors, clients or stores.

A goal that was sent is *deciding*. If it is accepted, the acceptance is written, then the goal is
*waiting* for its turn. When that comes, the begin of the attempt is written (if it comes at once,
with the acceptance), the executor is *called*, and from its first step the goal is *running*. The
end is fixed before it is written: from then on it never changes, and a cancel comes too late. When
it is kept, the goal has *ended*. A goal that comes from a store begins as *waiting*, or *ended*.

All that clients are told is kept first. So each thing that is told has two events: one that fixes
and writes it, and one, `..._KEPT`, that tells it. On a server without a store, all is kept as soon
as it is fixed: each effect that writes gives way to what follows when the write is kept. That
table, `LIFE_IN_MEMORY`, is made from the first one (`without_writes`).

Clients are told a status only by the effects `TELL_...`. It is ACCEPTED from the acceptance,
EXECUTING from the first step, CANCELING when an accepted cancel is kept, and terminal when the end
is kept. A cancel does not change the phase: the executor may still clean up, or yield its result.

A goal may be taken over by the executor of another one, which runs already. It is *running ahead*
until its begin is kept; that has an event of its own, because the goal may have ended by then.

A goal may also go without an end here. It is *released* to be run again later, or because the
store or the server has stopped; or it is *lost*, because another server has it. Only the first of
these is written.

In all of the server, these words mean:

| Word | What happens |
| --- | --- |
| end | The outcome of a goal is fixed, and clients are told when it is kept. |
| give up | A goal ends in place of another attempt. |
| withdraw | A goal is not decided, and is decided again if it is sent again. |
| release | A goal goes without an end: the store has it, to be run again. |
| lose | A goal goes without an end: another server has it. |
| leave | The executor of a goal is gone, and the goal has no part in the schedule any more. |
| forget | The outcome of a goal that has ended is not remembered any more. |
| drop | An outcome that was forgotten is not kept for its reader either. |
| kill | Each `await` of an executor is canceled. |
| abandon | An executor that survives this is not awaited any more. |
| close | A part takes nothing new. |

The status itself has a table of its own: see `fibaction.words.statuses`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Protocol, TypeAlias, TypeVar

from fibaction.words.action_error import ActionError


class Phase(IntEnum):
    """A phase of a goal's life, in the order in which they come."""

    DECIDING = 0
    ACCEPTANCE_IN_WRITING = 1
    WAITING = 2
    """Accepted; the executor has no turn yet."""
    BEGIN_IN_WRITING = 3
    """The goal has its turn."""
    CALLED = 4
    """The executor takes its first step soon."""
    RUNNING_AHEAD = 5
    """An executor that runs already has taken the goal over, and the begin is being written."""
    RUNNING = 6
    END_IN_WRITING = 7
    RELEASE_IN_WRITING = 8
    ENDED = 9
    RELEASED = 10
    REJECTED = 11
    LOST = 12
    """Another server has the goal: nothing is told or written about it here."""

    def __init__(self, number: int) -> None:
        self.is_open = number < 7
        """True until the end of the goal is fixed, or the goal leaves without one."""


class Event(IntEnum):
    """An event in the life of a goal."""

    ACCEPT = 0
    ACCEPTANCE_KEPT = 1
    BEGIN = 2
    """The goal has its turn."""
    BEGIN_KEPT = 3
    EXECUTE = 4
    """The executor takes its first step."""
    TAKE_OVER = 5
    """The executor of another goal continues as this one."""
    TAKE_OVER_KEPT = 6
    CANCEL = 7
    """A client's cancel was accepted."""
    CANCEL_GENTLY = 8
    """The same, on a server whose executors look for themselves whether they are to stop."""
    CANCEL_KEPT = 9
    STOP = 10
    """The server ends the goal for a reason of its own."""
    END = 11
    """The outcome is fixed."""
    END_KEPT = 12
    TOO_LARGE = 13
    """The store cannot keep what is being written."""
    RELEASE = 14
    """The goal is to be run again later."""
    RELEASE_KEPT = 15
    RELEASE_UNWRITTEN = 16
    """The store has failed, or the server has stopped before it has answered."""
    LOSE = 17
    """Another server turns out to have the goal."""


class Effect(IntEnum):
    """An act that follows an event."""

    WRITE_ACCEPTANCE = 0
    TELL_ACCEPTED = 1
    """Answer the call that has sent the goal, and let the goal wait for its turn."""
    TELL_TOO_LARGE = 2
    """Reject the goal, since the store cannot keep it."""
    WITHDRAW = 3
    """Forget the goal, and tell the call that another server has it."""
    WRITE_BEGIN = 4
    WRITE_TAKE_OVER = 5
    WRITE_CANCEL = 6
    WRITE_END = 7
    WRITE_RELEASE = 8
    CALL = 9
    """Let the executor begin."""
    INTERRUPT = 10
    """Raise a cancellation in the executor."""
    REMOVE = 11
    """Take the goal from those that are active."""
    END_UNBEGUN = 12
    """End the goal as canceled, in place of an executor. It has no place in the schedule."""
    END_AND_LEAVE = 13
    """The same for a goal that has a place, and gives it back."""
    TELL_EXECUTING = 14
    TELL_TAKE_OVER = 15
    TELL_CANCELING = 16
    TELL_END = 17
    TELL_GONE = 18
    """End the streams of the goal with an error, and forget it."""
    LEAVE = 19
    """Give back the goal's place in the schedule."""
    STOP_LOST = 20
    """Stop the executor of a lost goal; without one, give back the place."""
    RUN_AHEAD = 21
    """Execute the goal, and hide all that its executor yields until the begin is told."""


class Step(NamedTuple):
    """The answer of the table to an event."""

    phase: Phase
    effects: tuple[Effect, ...]


class InvalidStep(ActionError):
    """An event that a phase does not allow: a bug in fibaction, not in the code that uses it."""

    def __init__(self, phase: Phase, event: Event) -> None:
        super().__init__(phase, event)
        self.phase = phase
        self.event = event

    def __str__(self) -> str:
        return f"{self.event.name} cannot happen to a goal in the phase {self.phase.name}"


T = TypeVar("T")

_HAS_TURN = (Phase.CALLED, Phase.RUNNING_AHEAD, Phase.RUNNING)
_OPEN = (Phase.WAITING, Phase.BEGIN_IN_WRITING, *_HAS_TURN)
_IN_WRITING = (Phase.END_IN_WRITING, Phase.RELEASE_IN_WRITING)
_OVER = (*_IN_WRITING, Phase.ENDED, Phase.RELEASED, Phase.LOST)

_Table = dict[tuple[Phase, Event], Step]


def _same(phases: tuple[Phase, ...], event: Event, *effects: Effect) -> _Table:
    """Return rows for an event that leaves each of these phases as it is."""
    return {(phase, event): Step(phase, effects) for phase in phases}


def _to(target: Phase, phases: tuple[Phase, ...], event: Event, *effects: Effect) -> _Table:
    """Return rows for an event that leads from each of these phases to the same one."""
    return {(phase, event): Step(target, effects) for phase in phases}


class LifeTable(dict[tuple[Phase, Event], T]):
    """A table by phase and event. A pair without a row raises `InvalidStep`."""

    def __missing__(self, step: tuple[Phase, Event]) -> T:
        raise InvalidStep(*step)


LIFE: Final[Mapping[tuple[Phase, Event], Step]] = MappingProxyType(
    LifeTable(
        # Acceptance.
        _to(
            Phase.ACCEPTANCE_IN_WRITING,
            (Phase.DECIDING,),
            Event.ACCEPT,
            Effect.WRITE_ACCEPTANCE,
        )
        | _to(
            Phase.WAITING,
            (Phase.ACCEPTANCE_IN_WRITING,),
            Event.ACCEPTANCE_KEPT,
            Effect.TELL_ACCEPTED,
        )
        | _to(
            Phase.REJECTED,
            (Phase.ACCEPTANCE_IN_WRITING,),
            Event.TOO_LARGE,
            Effect.TELL_TOO_LARGE,
        )
        | _to(Phase.LOST, (Phase.ACCEPTANCE_IN_WRITING,), Event.LOSE, Effect.WITHDRAW)
        # Begin: a goal may have ended before its turn comes, or while that is written.
        | _to(Phase.BEGIN_IN_WRITING, (Phase.WAITING,), Event.BEGIN, Effect.WRITE_BEGIN)
        | _same(_OVER, Event.BEGIN)
        | _to(Phase.CALLED, (Phase.BEGIN_IN_WRITING,), Event.BEGIN_KEPT, Effect.CALL)
        | _same(_IN_WRITING, Event.BEGIN_KEPT)
        | _to(Phase.RUNNING, (Phase.CALLED,), Event.EXECUTE, Effect.TELL_EXECUTING)
        | _same(_OVER, Event.EXECUTE)  # it was killed before its first step
        | _to(
            Phase.RUNNING_AHEAD,
            (Phase.WAITING,),
            Event.TAKE_OVER,
            Effect.RUN_AHEAD,
            Effect.WRITE_TAKE_OVER,
        )
        | _to(Phase.RUNNING, (Phase.RUNNING_AHEAD,), Event.TAKE_OVER_KEPT, Effect.TELL_TAKE_OVER)
        | _same(_IN_WRITING, Event.TAKE_OVER_KEPT, Effect.TELL_TAKE_OVER)
        # Cancel, and stop. An executor that was not called yet sees both before its first step.
        | _same((Phase.WAITING,), Event.CANCEL, Effect.WRITE_CANCEL, Effect.END_AND_LEAVE)
        | _same((Phase.WAITING,), Event.CANCEL_GENTLY, Effect.WRITE_CANCEL, Effect.END_AND_LEAVE)
        | _same((Phase.BEGIN_IN_WRITING,), Event.CANCEL, Effect.WRITE_CANCEL)
        | _same(_HAS_TURN, Event.CANCEL, Effect.WRITE_CANCEL, Effect.INTERRUPT)
        | _same((Phase.BEGIN_IN_WRITING, *_HAS_TURN), Event.CANCEL_GENTLY, Effect.WRITE_CANCEL)
        | _same((*_OPEN, Phase.END_IN_WRITING), Event.CANCEL_KEPT, Effect.TELL_CANCELING)
        | _same((Phase.WAITING,), Event.STOP, Effect.END_UNBEGUN)
        | _same((Phase.BEGIN_IN_WRITING,), Event.STOP)
        | _same(_HAS_TURN, Event.STOP, Effect.INTERRUPT)
        # The end. A goal that is killed while its begin is written has no executor that leaves
        # later.
        | _to(Phase.END_IN_WRITING, _OPEN, Event.END, Effect.WRITE_END)
        | _to(
            Phase.END_IN_WRITING,
            (Phase.BEGIN_IN_WRITING,),
            Event.END,
            Effect.WRITE_END,
            Effect.LEAVE,
        )
        | _to(Phase.END_IN_WRITING, (Phase.END_IN_WRITING,), Event.TOO_LARGE, Effect.WRITE_END)
        | _to(Phase.ENDED, (Phase.END_IN_WRITING,), Event.END_KEPT, Effect.REMOVE, Effect.TELL_END)
        # Without an end here.
        | _to(Phase.RELEASE_IN_WRITING, _OPEN, Event.RELEASE, Effect.WRITE_RELEASE)
        | _to(
            Phase.RELEASE_IN_WRITING,
            (Phase.BEGIN_IN_WRITING,),
            Event.RELEASE,
            Effect.WRITE_RELEASE,
            Effect.LEAVE,
        )
        | _to(
            Phase.RELEASED,
            (Phase.RELEASE_IN_WRITING,),
            Event.RELEASE_KEPT,
            Effect.REMOVE,
            Effect.TELL_GONE,
        )
        | _to(
            Phase.RELEASED,
            (*_OPEN, *_IN_WRITING),
            Event.RELEASE_UNWRITTEN,
            Effect.REMOVE,
            Effect.TELL_GONE,
        )
        | _to(
            Phase.LOST,
            (*_OPEN, *_IN_WRITING),
            Event.LOSE,
            Effect.REMOVE,
            Effect.TELL_GONE,
            Effect.STOP_LOST,
        )
        # A write about a goal may be refused when it is not here any more.
        | _to(Phase.LOST, (Phase.ENDED, Phase.RELEASED, Phase.LOST, Phase.REJECTED), Event.LOSE)
    )
)
"""Every step that may happen; all others are bugs."""

KEPT: Final[Mapping[Effect, Event]] = MappingProxyType(
    {
        Effect.WRITE_ACCEPTANCE: Event.ACCEPTANCE_KEPT,
        Effect.WRITE_BEGIN: Event.BEGIN_KEPT,
        Effect.WRITE_TAKE_OVER: Event.TAKE_OVER_KEPT,
        Effect.WRITE_CANCEL: Event.CANCEL_KEPT,
        Effect.WRITE_END: Event.END_KEPT,
        Effect.WRITE_RELEASE: Event.RELEASE_KEPT,
    }
)
"""The event that follows each effect that writes, when the write is kept."""


def without_writes(life: Mapping[tuple[Phase, Event], Step]) -> Mapping[tuple[Phase, Event], Step]:
    """Return the same table for a server that keeps all at once: each effect that writes gives way
    to the step that follows when the write is kept.
    """
    table: LifeTable[Step] = LifeTable()
    for at, step in life.items():
        phase, effects = step.phase, list[Effect]()
        for effect in step.effects:
            if effect in KEPT:
                kept = life[phase, KEPT[effect]]
                phase = kept.phase
                effects += kept.effects
            else:
                effects.append(effect)
        table[at] = Step(phase, tuple(effects))
    return MappingProxyType(table)


LIFE_IN_MEMORY: Final[Mapping[tuple[Phase, Event], Step]] = without_writes(LIFE)
"""Every step on a server without a store."""


class GoalInPhase(Protocol):
    """The record of a goal, as far as its life is concerned."""

    phase: Phase


class Living(Protocol):
    """A goal that takes steps: first as an offer, then as a run."""

    @property
    def goal(self) -> GoalInPhase:
        """The record of the goal."""
        ...


Acts: TypeAlias = dict[Effect, Callable[[Any], None]]
"""The functions that carry out effects, each for an offer or a run."""


class Life(dict[tuple[Phase, Event], tuple[Phase, tuple[Callable[[Any], None], ...]]]):
    """The interpreter of a table for the goals of one server: its rows with functions as effects.

    A row is made when it is needed first, so the parts that carry out the effects may follow.
    """

    def __init__(self, table: Mapping[tuple[Phase, Event], Step]) -> None:
        super().__init__()
        self._table = table
        self._acts: Acts = {}

    def carry_out(self, acts: Acts) -> None:
        """Carry out effects by these functions."""
        self._acts |= acts

    def step(self, living: Living, event: Event) -> None:
        """Let a goal make the step that follows from an event.

        Raises:
            InvalidStep: The event cannot happen in the phase of the goal.
        """
        goal = living.goal
        goal.phase, acts = self[goal.phase, event]
        for act in acts:
            act(living)

    def __missing__(
        self, at: tuple[Phase, Event]
    ) -> tuple[Phase, tuple[Callable[[Any], None], ...]]:
        step = self._table[at]
        row = self[at] = step.phase, tuple(self._acts[effect] for effect in step.effects)
        return row
