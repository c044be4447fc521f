"""`KeyEntry`: the record of a key, which says which workers run its goals, and which wait.

Theory of operation
-------------------

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

from collections.abc import Set
from typing import NamedTuple

import msgspec

from fibaction_transports.nats.records import reader


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
