"""`GoalStore`: the interface of a place where goals outlive the process of their server.

Theory of operation
-------------------

A server opens a store for its action, gets the goals that are kept there (`claim`), and writes each
step of a goal's life into a `GoalJournal`: accepted, begun, cancel accepted, checkpoint, ended. It
tells a client nothing that is not kept yet.

Each method of a journal takes what it needs of the `StoredGoal` and returns at once. Its `then` is
called on the event loop when the write is durable: with None, or with the error if it has failed.
The calls of `then` come in the order of the writes. After a `StoreError` nothing can be written any
more; after a `GoalTaken` this goal belongs to another server, which it tells apart. After a
`RecordTooLarge` this write alone has failed: of `accept`, `checkpoint` or `end`.

A goal can come to a server at any time, always by `claim`: it was found when the store was opened,
it was left by another server that is gone, or it comes from a queue that several servers share.

A store that several servers share asks a server whether it can run a goal (`obstacle`) before the
goal becomes its own: their programs may be of different versions, and a goal that one of them
cannot read may be run by another.

A store does not depend on executors, schedules or transports, and a server does not know what a
store writes to.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from copy import copy
from typing import TypeAlias

import msgspec

from fibaction._runtime.text import LENGTH, shortened
from fibaction.words.errors import StoreError
from fibaction.words.goal_query import GoalQuery, PastPage, read_pages
from fibaction.words.goals import GoalID, GoalInfo, Outcome, Sender, child_id
from fibaction.words.meta import labels_in, meta_after_end, parent_in
from fibaction.words.statuses import GoalStatus


class StoredGoal(msgspec.Struct, array_like=True, gc=False):
    """The state of a goal as it is kept in a store."""

    goal_id: GoalID
    stamp: int
    """Time of the acceptance: nanoseconds since 1970."""
    sender: Sender
    """The client that owns the goal."""
    digest: bytes
    """Digest of the goal, which tells a retry from another goal with the same ID."""
    goal: bytes
    """The goal as it was sent; empty after the end, unless it was given up."""
    deadline: int = 0
    """Time at which the client gives up the goal: nanoseconds since 1970; 0 if it does not."""
    status: GoalStatus = GoalStatus.ACCEPTED
    """ACCEPTED, CANCELING, or an end; never EXECUTING, which `attempt` tells."""
    is_running: bool = False
    """True from the begin of an attempt until the goal ends or is released."""
    attempt: int = 0
    """The number of attempts that have begun."""
    lost: int = 0
    """The number of attempts whose process was gone before the goal ended or was released, since
    the last checkpoint that was another one than before it."""
    checkpoint: bytes | None = None
    """The last checkpoint of the executor; None if there is none, and after the end, unless the
    goal was given up."""
    result: bytes | None = None
    """The result of a goal that has ended, or what there is of it."""
    reason: str = ""
    """The reason of the end; before it, the reason for which the goal is a suspect."""
    feedback_count: int = 0
    """The number of feedback messages of the last attempt; known after the end."""
    ended_at: int = 0
    """Time of the end: nanoseconds since 1970; 0 while the goal is active."""
    keep_until: int = 0
    """Time until which the outcome is kept: nanoseconds since 1970; 0 forever."""
    worker: str = ""
    """The name of the worker that has the goal; empty if the store has one server for each action.
    """
    meta: dict[str, str] | None = None
    """The small text map that came with the goal, of which the parent and the labels are left after
    the end, unless the goal was given up; None if it is empty."""
    began_at: int = 0
    """Time at which the first attempt began: nanoseconds since 1970; 0 if none has, or if an
    earlier version of fibaction has run it."""

    @property
    def told_status(self) -> GoalStatus:
        """The status that clients know: an active goal that has begun is EXECUTING."""
        has_begun = self.attempt and self.status is GoalStatus.ACCEPTED
        return GoalStatus.EXECUTING if has_begun else self.status

    @property
    def is_suspect(self) -> bool:
        """True of a goal of an earlier process that may have ended it: it was the second time that
        the goal has lost an attempt since its last new checkpoint, or a later one.
        """
        return self.status is GoalStatus.ACCEPTED and self.lost + self.is_running >= 2

    @property
    def outcome(self) -> Outcome[bytes]:
        """The outcome of a goal that has ended."""
        return Outcome(self.status, self.result, self.reason, self.ended_at or None)

    def end(self, outcome: Outcome[bytes]) -> None:
        """Note the outcome."""
        self.status, self.result = outcome.status, outcome.result
        self.reason, self.ended_at = outcome.reason, outcome.ended_at or 0
        self.is_running = False

    @property
    def info(self) -> GoalInfo:
        """The goal as an entry of a list."""
        return GoalInfo(
            self.goal_id,
            self.stamp,
            self.told_status,
            self.feedback_count,
            str(self.sender),
            attempt=max(self.attempt, 1),
            parent=parent_in(self.meta),
            began_at=self.began_at or None,
            ended_at=self.ended_at or None,
            reason=shortened(self.reason, LENGTH),
            labels=labels_in(self.meta),
            worker=self.worker,
        )

    @property
    def is_given_up(self) -> bool:
        """True if the goal has ended and is kept whole: its server has given it up."""
        return self.status.is_terminal and bool(self.goal)

    def drop_request(self) -> None:
        """Forget what is needed only to run the goal: see `meta`."""
        self.goal, self.checkpoint = b"", None
        if self.meta is not None:
            self.meta = meta_after_end(self.meta)

    def listed(self) -> StoredGoal:
        """Return what a list of a history tells of the goal: all but its request and its result."""
        line = copy(self)
        line.goal, line.result, line.checkpoint = b"", None, None
        line.meta, line.reason = meta_after_end(self.meta), shortened(self.reason, LENGTH)
        return line

    def as_new(self, stamp: int) -> StoredGoal:
        """Return a goal that was given up as a new one, to run from its last checkpoint.

        Its ID follows from that of the old one, so the same goal is run again once.
        """
        return StoredGoal(
            child_id(self.goal_id, "", "run again"),
            stamp,
            self.sender,
            self.digest,
            self.goal,
            checkpoint=self.checkpoint,
            meta=self.meta,
        )


def checkpoint_to_tell(given_up: StoredGoal | None) -> bytes | None:
    """Return the checkpoint of a goal that was given up, as `GoalStream.checkpoint`; None if there
    is no such goal.
    """
    return None if given_up is None else given_up.checkpoint or b""


Then: TypeAlias = Callable[[StoreError | None], None]
"""The function that is called on the event loop when a write is durable, or has failed."""


class GoalTaken(StoreError):
    """The goal belongs to another server by now; this one may write nothing more about it."""


class RecordTooLarge(StoreError):
    """The goal, its checkpoint or its result is too large for the store; the text says how large.

    Nothing was written, and the other goals are not affected.
    """


class NotGivenUp(StoreError):
    """The goal was not given up, or runs again already; the text says which."""


class StoreFull(RecordTooLarge):
    """The store has no room for another goal now; the text says why.

    Only `accept` fails with it: what is about a goal that is kept waits for room.
    """


class NoFleet(ValueError):
    """A schedule has a limit for all workers of a fleet, and its server is in none."""

    def __init__(self, limit: str) -> None:
        super().__init__(
            f"fleet_limit={limit!r} needs a fleet: serve the action at nats://, or leave it out"
        )


class KeySlots(ABC):
    """The slots for goals that run, of each key of a limit that several servers have together.

    A server asks for a slot before it begins a goal, and gives it back when the executor is gone.
    Both show by the numbers that it notes. A key whose goals neither run nor wait takes nothing.
    """

    @abstractmethod
    def open(self, granted: Callable[[bytes], None]) -> None:
        """Use the slots from now on. Call `granted` with a key each time one more of its goals may
        run: before it returns, the goal is noted as one that runs, or the slot is given back.

        Raises:
            ValueError: Another schedule of this worker uses them.
        """

    @abstractmethod
    def note(self, key: bytes, running: int, asked: int) -> None:
        """Note how many goals of a key run here, and for how many more there is to be a slot."""

    @abstractmethod
    def close(self) -> None:
        """Use the slots no longer."""


OpenKeySlots: TypeAlias = Callable[[str, int], Awaitable[KeySlots]]
"""Returns the slots of a limit of that name; each key has so many of them."""


def no_obstacle(_goal: StoredGoal) -> str:
    """Return what keeps a server from running a goal if it runs every goal: nothing."""
    return ""


class PastSource:
    """The history of an action: goals that are kept beyond their outcomes; here there are none."""

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        """Return a page of them. The server may remember some of them as well.

        Raises:
            StoreError: They cannot be read.
        """
        return []

    async def read_past(self, wanted: GoalQuery, take: Callable[[list[GoalInfo]], None]) -> None:
        """Call `take` with all of them that are wanted, in parts and in any order.

        Raises:
            StoreError: They cannot be read.
        """
        await read_pages(self.past_goals, wanted, take)

    async def past_goal(self, goal_id: GoalID) -> StoredGoal | None:
        """Return one of them with its request and its result; None if it is not there.

        Raises:
            StoreError: It cannot be read.
        """
        return None

    async def given_up(self, goal_id: GoalID) -> StoredGoal | None:
        """Return a goal that was given up and can be run again, with its request and its last
        checkpoint; None if there is none of that ID.

        Raises:
            StoreError: It cannot be read.
        """
        return None

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        """Keep a new goal that runs one which was given up again, from its last checkpoint; a
        server gets it by `claim`. Return its ID; None if the goal was not given up, or runs again.

        Raises:
            StoreError: It cannot be kept.
        """
        return None


class IntakeSource:
    """The record of how an action takes new goals, as bytes of its server; here in memory."""

    intake_period: float = math.inf
    """Seconds after which another server of the store may have changed it."""
    _intake: bytes = b""

    async def intake(self) -> bytes:
        """Return what is kept; empty if nothing is.

        Raises:
            StoreError: It cannot be read.
        """
        return self._intake

    async def change_intake(self, change: Callable[[bytes], bytes]) -> bytes:
        """Keep what `change` makes of what is kept, and return it when it is durable. `change` may
        be called again, if another server was faster, and on another thread.

        Raises:
            StoreError: It cannot be kept.
        """
        self._intake = change(self._intake)
        return self._intake


class GoalJournal(PastSource, IntakeSource, ABC):
    """The goals of one action in an open store. See the module for the rules of all methods."""

    @property
    def valid_until(self) -> float:
        """Time by the event loop's clock until which the goals belong to this server for certain.

        From then on no executor may take another step, unless it has become later meanwhile.
        """
        return math.inf

    def set_capacity(self, running: float, waiting: float) -> None:  # most need no room
        """Note how many more goals the server can run now, and how many more can wait in its queue.

        Both are 0 while the server starts, drains or stops, and `math.inf` without a limit. The
        server calls it each time one of them becomes zero, or more than zero. A store that several
        servers share hands over goals by it.
        """

    async def key_slots(self, limit: str, most: int) -> KeySlots:
        """Return the slots of a limit of that name, which all servers of the store have together;
        each key has at most so many. Goals that wait for one stay at this server.

        Raises:
            NoFleet: The store has one server for each action.
            StoreError: It does not answer.
        """
        raise NoFleet(limit)

    @abstractmethod
    def accept(self, goal: StoredGoal, then: Then) -> None:
        """Keep a new goal, which is running already if it need not wait."""

    @abstractmethod
    def begin(self, goal: StoredGoal, then: Then) -> None:
        """Keep that an attempt begins: `is_running`, `attempt`, `lost` and, with the first one,
        `began_at` have changed.
        """

    @abstractmethod
    def cancel(self, goal: StoredGoal, then: Then) -> None:
        """Keep that a cancel of the goal was accepted: `status` is CANCELING."""

    @abstractmethod
    def checkpoint(self, goal: StoredGoal, then: Then) -> None:
        """Keep a checkpoint: `checkpoint` has changed."""

    @abstractmethod
    def end(self, goal: StoredGoal, then: Then) -> None:
        """Keep the end of the goal: `status` is terminal, and all fields of an end are set.

        The parts that are needed only to run the goal are not kept any longer, unless it was given
        up: then `goal` is not empty.
        """

    @abstractmethod
    def release(self, goal: StoredGoal, then: Then) -> None:
        """Keep that the goal is free, to be run again: `is_running` is False."""


class GoalStore(ABC):
    """A place where the goals of servers outlive their process."""

    @abstractmethod
    def open(
        self,
        action: str,
        *,
        max_results: int,
        claim: Callable[[StoredGoal], None],
        lose: Callable[[GoalID], None],
        obstacle: Callable[[StoredGoal], str] = no_obstacle,
        ends_unreadable: bool = False,
    ) -> AbstractAsyncContextManager[GoalJournal]:
        """Open the store for the goals of an action, for as long as the block lasts.

        Before the block begins, `claim` is called for each goal that is kept: first for those that
        have ended, in the order of their ends, then for the active ones, in the order of their
        stamps. Later it is called for each goal that this server is to take over. At most
        `max_results` ended goals are kept; the oldest are forgotten, and so are those whose
        `keep_until` has passed. `lose` is called for a goal that another server has taken over. The
        end of the block waits for the writes that are under way.

        `obstacle` returns why the server cannot run a goal, such as a field of its type that the
        goal does not have; the text is empty if it can. A store that several servers share calls it
        before a goal becomes the server's own, and leaves the goal to the others if there is one.
        A store of one server need not call it: the server looks at what it claims by itself. With
        `ends_unreadable`, the server also gets the goals that no server can run any more, and ends
        them.

        Raises:
            StoreError: The store cannot be used, or is in use; the text says why.
        """
