"""`Suspects`: goals that may be the ones that end the process; they run alone, one after another.

Theory of operation
-------------------

A goal that ends its process takes all goals with it that run there, and each of them has lost an
attempt. After the second one, each is a suspect (`StoredGoal.is_suspect`). A suspect begins when
nothing else runs, and while suspects run or wait for that, no other goal begins. So from then on, a
crash meets one goal only, and the others are not given up because of it.

A suspect is on trial until its end is kept, or it keeps a new checkpoint, or `TRIAL` seconds are
over: then the next one has its turn, and after the last one all others begin. A goal that runs
already and does not end delays the trial for so long at most. Goals that a suspect has sent begin
while it is on trial, because it may wait for them. Of many suspects, each has a shorter trial: all
together delay the others for `ALL_TRIALS` seconds at most.

One `Suspects` is that of all servers of an event loop, since a crash meets all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from anyio import current_time, move_on_after
from anyio.lowlevel import RunVar

from fibaction._runtime.notify import Notifier

if TYPE_CHECKING:
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.words.goals import GoalID

TRIAL = 30.0
"""Seconds for which a suspect runs alone at most, and for which it waits for goals that run."""
ALL_TRIALS = 300.0
"""Seconds for which other goals wait for all suspects together, at most."""


class Server(Protocol):
    """The goals of one server: see `Runs`."""

    def has_begun_others(self, goal: GoalRecord) -> bool:
        """Return whether other goals than this one and its parent have begun, and not ended."""
        ...

    def note_suspects(self) -> None:
        """Tell the store that other goals begin again, or do not begin."""
        ...


class Suspects:
    """The suspects of one event loop."""

    def __init__(self) -> None:
        self.goals: dict[GoalRecord, Server] = {}
        """The suspects that are on trial, or wait for it; no other goal begins if there are any."""
        self.left = Notifier()
        """Notifies of each goal that has ended, or is no suspect any more."""
        self._turn = Notifier()
        self._ends = 0.0  # the time at which no other goal waits any more
        self._on_trial: set[GoalID] = set()  # a suspect, and the goals that it has sent
        self._servers: set[Server] = set()

    def join(self, server: Server) -> None:
        """Let the goals of a server wait for suspects, and these for them."""
        self._servers.add(server)

    def quit(self, server: Server) -> None:
        """Wait for the goals of a server no longer."""
        self._servers.discard(server)
        for goal in [goal for goal, its_server in self.goals.items() if its_server is server]:
            self._discard(goal)
        self.left.notify()

    def may_begin(self, goal: GoalRecord) -> bool:
        """Return whether a goal that is no suspect begins now."""
        return not self.goals or self._is_sent_by_suspect(goal)

    def _is_sent_by_suspect(self, goal: GoalRecord) -> bool:
        if (parent := goal.origin.parent) is not None:
            self.note_sent(goal.goal_id, parent.goal_id)
        return goal.goal_id in self._on_trial

    def note_sent(self, goal_id: GoalID, sender: GoalID | None) -> None:
        """Note the goal whose executor has sent a goal: that of a suspect on trial may begin."""
        if sender in self._on_trial:
            self._on_trial.add(goal_id)

    def add(self, goal: GoalRecord, server: Server) -> None:
        """Let no other goals begin: there is a suspect, which is to `begin`."""
        if not self.goals:
            self._ends = current_time() + ALL_TRIALS
        self.goals[goal] = server
        self._note_change()

    async def begin(
        self, goal: GoalRecord, begin: Callable[[], None], is_active: Callable[[], bool]
    ) -> None:
        """Begin a goal when it may begin, and stay until the trial is over if it is a suspect."""
        if not goal.suspicion:
            while not self.may_begin(goal):
                await self._turn.wait()
            begin()
            return
        try:
            is_sent = False
            while self._on_trial and not (is_sent := self._is_sent_by_suspect(goal)):
                await self._turn.wait()
            if is_sent:
                begin()
            else:
                await self._try(goal, begin, is_active)
        finally:
            self._discard(goal)

    async def _try(
        self, goal: GoalRecord, begin: Callable[[], None], is_active: Callable[[], bool]
    ) -> None:
        self._on_trial.add(goal.goal_id)
        self._turn.notify()  # goals that it has sent in an earlier attempt may begin
        try:
            with move_on_after(self._share()):
                while is_active() and any(one.has_begun_others(goal) for one in self._servers):
                    await self.left.wait()
            begin()
            with move_on_after(self._share()):
                while is_active() and goal.suspicion:
                    await self.left.wait()
        finally:
            self._on_trial.clear()
            self._turn.notify()  # its server may have left already, and the goal with it

    def _share(self) -> float:
        """Return the seconds of each of the two waits of a trial: an equal part of what is left."""
        left = max(self._ends - current_time(), 0.0)
        return min(TRIAL, left / (2 * max(len(self.goals), 1)))

    def _discard(self, goal: GoalRecord) -> None:
        if self.goals.pop(goal, None) is not None:
            self._turn.notify()
            self._note_change()

    def clear(self, goal: GoalRecord) -> None:
        """Let a goal be no suspect any more: it has kept a new checkpoint."""
        goal.suspicion = ""
        self.left.notify()

    def _note_change(self) -> None:
        for server in tuple(self._servers):
            server.note_suspects()


_suspects = RunVar[Suspects]("_suspects")


def suspects_here() -> Suspects:
    """Return the suspects of this event loop."""
    suspects = _suspects.get(None)
    if suspects is None:
        suspects = Suspects()
        _suspects.set(suspects)
    return suspects
