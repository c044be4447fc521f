"""`NotesForOthers`: the notes of goals that a worker cannot run, which it gives back to the queue.

Theory of operation
-------------------

The workers of a fleet may be of different versions, and each of them takes all notes of its
actions. The first time that a worker takes the note of a goal that it cannot run, it warns of it,
and adds the note again at once, so that another worker finds it. A note that comes back was not
wanted by others, or no other was there: it is held before it is added again, each time for longer.
So notes that no living worker wants cost little, and those that come after them are not delayed.

The queue gives a note to the reader that has asked first. So a note is held for a second only, and
longer if there are very many, or this worker would mostly have asked before one that comes later.
It is held for less time than the queue gives a reader. If this worker is lost meanwhile, the
note comes again by itself. Scans may add a note of a goal that has one already: the second one is
removed while the first is held.
"""

from __future__ import annotations

from anyio import sleep
from anyio.abc import TaskGroup

from fibaction.border.goal_store import StoredGoal
from fibaction.border.peer_text import clean_logger
from fibaction.words.goals import GoalID
from fibaction_transports.nats.broker.broker import Broker, Note
from fibaction_transports.nats.worker.journal import FleetJournal
from fibaction_transports.nats.worker.lease import FIRST_PAUSE

HOLD, LONGEST_HOLD = 1.0, 4.0
"""Seconds for which a note is held; one that is not done comes again after five."""
RATE = 100.0
"""The number of notes in a second above which they are held for longer."""
MOST_KNOWN = 100_000
"""The number of goals whose warning is remembered."""

logger = clean_logger("fibaction.nats")


class NotesForOthers:
    """The notes that one worker gives back, of one action."""

    def __init__(self, broker: Broker, journal: FleetJournal, tasks: TaskGroup) -> None:
        """Hold notes in tasks of this group."""
        self._broker = broker
        self._journal = journal
        self._tasks = tasks
        self._pauses: dict[GoalID, float] = {}  # before the next return of a note
        self._held: set[tuple[str, GoalID]] = set()

    def give_back(self, subject: str, note: Note, goal: StoredGoal) -> bool:
        """Give the note of a goal back to its subject if the server cannot run the goal; return
        whether that is so.
        """
        obstacle = self._journal.obstacle(goal)
        if not obstacle:
            return False
        goal_id = goal.goal_id
        pause = self._pauses.get(goal_id)
        if pause is None:
            self._warn(goal_id, obstacle)
            self._broker.add_note(subject, note.data)
            note.done()
        elif (subject, goal_id) in self._held:
            note.done()
        else:
            longest = min(max(HOLD, len(self._held) / RATE), LONGEST_HOLD)
            self._pauses[goal_id] = min(2 * pause, longest)
            self._held.add((subject, goal_id))
            self._tasks.start_soon(self._hold, subject, note, goal_id, pause)
        return True

    def _warn(self, goal_id: GoalID, obstacle: str) -> None:
        if len(self._pauses) >= MOST_KNOWN:
            del self._pauses[next(iter(self._pauses))]
        self._pauses[goal_id] = FIRST_PAUSE
        logger.warning(
            "goal %s of %r cannot run at this worker, and is left to others: %s",
            goal_id,
            self._journal.action,
            obstacle,
        )

    async def _hold(self, subject: str, note: Note, goal_id: GoalID, pause: float) -> None:
        await sleep(pause)
        self._held.discard((subject, goal_id))
        self._broker.add_note(subject, note.data)
        note.done()
