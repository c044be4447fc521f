"""Records and messages of a fleet, as values and as bytes; and the record of a key that comes next.

`GoalEntry` is the record of a goal. Whoever writes it names the sequence of the entry that it
replaces, so exactly one worker can: the entry is the ownership. `LeaseEntry` is the record of a
worker, which says that it is there; it ends by its time to live. `RoomQuestion` and `RoomOffer` are
messages, by which a client finds a worker for new goals. `KeyEntry` is the record of a key, which
says which workers run its goals, and which wait.

Workers are told apart by incarnation, and not by name: a name may be used again.

A key has so many slots. A worker holds one for each goal that it runs, and waits for as many as it
could begin goals. Whoever writes the record gives free slots to the workers that wait, in the
order in which they have come (`next_entry`). A worker gets one slot at a time, and stands behind
the others for the next one, so it cannot keep a key for itself.

Workers whose lease has ended are left out of the next record. A worker that has more goals running
than the record says, because the record was lost, is written with all of them, even if these are
more than there are slots: then nobody gets one before some of them have ended.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any, NamedTuple, TypeVar

import msgspec

from fibaction.border.goal_store import StoredGoal
from fibaction.types.action import ActionInfo
from fibaction.words.errors import ProtocolError
from fibaction.words.statuses import GoalStatus

T = TypeVar("T")

SECOND = 1_000_000_000
"""Nanoseconds."""
INCARNATION_SIZE = 8
"""Bytes of an incarnation: random, so that no two workers ever have the same."""
NONCE_SIZE = 4
"""Bytes of a nonce, which tells whether a stored entry is the one that was just written."""
ROOM_TO_GROW = 512
"""Bytes by which the record of a new goal may grow until its end, and those of its headers."""


class GoalEntry(msgspec.Struct, array_like=True, gc=False):
    """The record of a goal."""

    goal: StoredGoal
    incarnation: bytes
    """The worker that has the goal, which `goal.worker` names; empty if no worker has it."""
    nonce: bytes
    """Random bytes of this write; behind them zeros, the room by which later records may grow."""

    @property
    def waits(self) -> bool:
        """True if the goal waits for its turn."""
        return not self.goal.is_running and self.goal.status is GoalStatus.ACCEPTED


class ServedAction(msgspec.Struct, array_like=True, frozen=True):
    """An action that a worker serves."""

    info: ActionInfo
    is_kept: bool
    """True if its goals have entries; False behind a gateway, whose servers keep their own."""
    unreadable: int = 0
    """The number of its goals that have no worker, and that this worker cannot run."""


class LeaseEntry(msgspec.Struct, array_like=True):
    """The record of a worker."""

    worker: str
    incarnation: bytes
    """Empty while a lost worker of this name is cleared up after: then `cleared_by` does that.
    Also empty if nothing is left to clear up: then `cleared_by` is empty as well."""
    since: int = 0
    """Time at which the worker joined: nanoseconds since 1970."""
    lease: float = 0.0
    """The time to live of this record, in seconds."""
    actions: tuple[ServedAction, ...] = ()
    goals: int = 0
    """The number of active goals when this was written."""
    has_room: bool = False
    """True if it answered questions for at least one action when this was written."""
    cleared_by: str = ""
    version: str = ""
    """The version of fibaction; empty if it is earlier than this field."""


class RoomQuestion(msgspec.Struct, array_like=True, frozen=True):
    """The message of a client that has new goals of an action."""

    goals: int
    """The number of goals, at least 1."""


class RoomOffer(msgspec.Struct, array_like=True, frozen=True):
    """The answer of a worker: it takes at most so many goals now."""

    worker: str
    goals: int


def _plain(value: Any) -> Any:
    """Return the bytes of a goal ID, the only type here that msgspec does not know."""
    return value[:]


def _made(wanted: Any, value: bytes) -> Any:
    return wanted(value)


encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode
"""Returns a value of this module as bytes."""


def reader(kind: type[T], what: str) -> Callable[[bytes], T]:
    """Return a function that reads a value from bytes, and raises `ProtocolError` if it cannot."""
    decoder = msgspec.msgpack.Decoder(kind, dec_hook=_made)

    def read(data: bytes) -> T:
        try:
            return decoder.decode(data)
        except (msgspec.MsgspecError, ValueError) as exc:
            raise ProtocolError(f"{what} of the fleet cannot be read: {exc}") from exc

    return read


goal_entry = reader(GoalEntry, "the record of a goal")
past_goal = reader(StoredGoal, "a record of the history")
"""Returns the goal in a record of the history, or in the head of one."""
lease_entry = reader(LeaseEntry, "the lease of a worker")
question = reader(RoomQuestion, "a question")
offer = reader(RoomOffer, "an offer")


def time_to_live(goal: StoredGoal, now: int, least: float = 1.0) -> float | None:
    """Return the seconds for which the record of a goal stays, at least so many; None if it has no
    end.
    """
    return max(least, (goal.keep_until - now) / SECOND) if goal.keep_until else None


def is_claim(data: bytes) -> bool:
    """Return whether the record of a worker is the claim to clear up after it."""
    try:
        return bool(lease_entry(data).cleared_by)
    except ProtocolError:
        return False


class KeyShare(msgspec.Struct, array_like=True, frozen=True):
    """The slots that one worker has, or waits for."""

    worker: str
    incarnation: bytes
    count: int


class KeyEntry(msgspec.Struct, array_like=True, frozen=True):
    """The record of a key of a limit."""

    key: bytes
    """The beginning of the key, of which the subject has a digest only."""
    holders: tuple[KeyShare, ...] = ()
    waiting: tuple[KeyShare, ...] = ()
    """The workers that wait, in the order of their turns."""
    gives_none: bool = False
    """True if it was written while its stream was new, so that slots may be missing in it."""
    nonce: bytes = b""
    """Random bytes of this write: without a change, it is another record nevertheless."""

    @property
    def is_empty(self) -> bool:
        """True if no worker has or wants a slot."""
        return not (self.holders or self.waiting)

    def asked_by(self, incarnation: bytes) -> int:
        """Return the number of slots that a worker waits for."""
        return sum(one.count for one in self.waiting if one.incarnation == incarnation)

    def held_by(self, incarnation: bytes) -> int:
        """Return the number of slots that a worker has."""
        return sum(one.count for one in self.holders if one.incarnation == incarnation)

    def says_the_same(self, other: KeyEntry) -> bool:
        """Return whether another record has the same workers in the same order."""
        return (self.holders, self.waiting) == (other.holders, other.waiting)


class Demand(NamedTuple):
    """The slots that one worker has in use, and those that it wants."""

    worker: str
    incarnation: bytes
    running: int
    asked: int


key_entry = reader(KeyEntry, "the record of slots of a key")


def next_entry(
    entry: KeyEntry, demand: Demand, gone: Set[bytes], most: int, *, gives: bool
) -> KeyEntry:
    """Return the record that follows from what a worker wants, without those that are gone.

    With `gives`, free slots are given to the workers that wait, as long as fewer than `most` are
    held.
    """
    me = demand.incarnation
    left = gone | {me}
    holders = {one.incarnation: one for one in entry.holders if one.incarnation not in left}
    if demand.running:
        holders[me] = KeyShare(demand.worker, me, demand.running)
    waiting = [one for one in entry.waiting if one.incarnation not in gone]
    mine = [KeyShare(demand.worker, me, demand.asked)] if demand.asked else []
    at = next((at for at, one in enumerate(waiting) if one.incarnation == me), None)
    if at is None:
        waiting += mine
    else:
        waiting[at : at + 1] = mine
    while gives and waiting and sum(one.count for one in holders.values()) < most:
        first = waiting.pop(0)
        held = holders.get(first.incarnation)
        count = 1 if held is None else held.count + 1
        holders[first.incarnation] = msgspec.structs.replace(first, count=count)
        if first.count > 1:
            waiting.append(msgspec.structs.replace(first, count=first.count - 1))
    in_order = sorted(holders.values(), key=lambda one: one.incarnation)
    return KeyEntry(entry.key, tuple(in_order), tuple(waiting), gives_none=not gives)


def given(before: KeyEntry, after: KeyEntry) -> list[str]:
    """Return the names of the workers that have more slots in a record than in the one before."""
    return [one.worker for one in after.holders if one.count > before.held_by(one.incarnation)]
