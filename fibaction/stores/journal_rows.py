"""Rows of a journal: what happened to goals, as bytes, and the goals that it adds up to.

Theory of operation
-------------------

A journal is a sequence of numbered rows. A row holds the records of one commit, in msgpack: a goal
that was accepted with all its fields, and later only what changed. The first row of a journal
begins with `StartRecord`. `KeptGoals` adds records up to the goals as they are now; it can write
them down again as the first rows of a new journal, which replaces the old one and is smaller.

Each row begins with a checksum of its number and its bytes: the database has none of its own.

Sans-I/O: nothing here reads or writes a file.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias

import msgspec

from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

ROW = 256 * 1024
"""Bytes after which `KeptGoals.rows` begins a new row."""
SLICE = 4096
"""Bytes that zlib takes at once. From 5 KiB on it would release the interpreter, and wait for a
busy event loop to get it back."""


class DamagedRow(Exception):
    """A row of a journal is missing, or its bytes are not what was written."""


class StartRecord(msgspec.Struct, array_like=True, tag=0, gc=False):
    """The begin of a journal: there is nothing before it."""


class WholeRecord(msgspec.Struct, array_like=True, tag=1, gc=False):
    """A goal with all its fields: it was accepted, or is copied from an older journal."""

    action: str
    goal: StoredGoal


class StateRecord(msgspec.Struct, array_like=True, tag=2, gc=False):
    """An attempt begins, a cancel was accepted, or the goal is free."""

    action: str
    goal_id: bytes
    status: int
    is_running: bool
    attempt: int
    lost: int
    began_at: int = 0
    """The time of the first begin; 0 if there was none, or in a row of an earlier version."""


class CheckpointRecord(msgspec.Struct, array_like=True, tag=3, gc=False):
    """A checkpoint of a goal."""

    action: str
    goal_id: bytes
    checkpoint: bytes | None


class EndRecord(msgspec.Struct, array_like=True, tag=4, gc=False):
    """The end of a goal."""

    action: str
    goal_id: bytes
    status: int
    attempt: int
    lost: int
    result: bytes | None
    reason: str
    feedback_count: int
    ended_at: int
    keep_until: int
    is_given_up: bool = False
    """True if the goal and its checkpoint are kept."""


Record: TypeAlias = StartRecord | WholeRecord | StateRecord | CheckpointRecord | EndRecord


def _plain(value: Any) -> Any:
    """Return the bytes of a goal ID, the only type here that msgspec does not know."""
    return value[:]


def _made(wanted: Callable[[bytes], Any], value: bytes) -> Any:
    return wanted(value)


_encode = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_decode = msgspec.msgpack.Decoder(list[Record], dec_hook=_made).decode


def moved(action: str, goal: StoredGoal) -> StateRecord:
    """Return the record of a begin, a cancel or a release."""
    return StateRecord(
        action,
        goal.goal_id,
        int(goal.status),
        goal.is_running,
        goal.attempt,
        goal.lost,
        goal.began_at,
    )


def ended(action: str, goal: StoredGoal) -> EndRecord:
    """Return the record of an end."""
    reason = goal.reason
    if not reason.isascii():
        reason = reason.encode(errors="replace").decode()  # half a character cannot be written
    return EndRecord(
        action,
        goal.goal_id,
        int(goal.status),
        goal.attempt,
        goal.lost,
        goal.result,
        reason,
        goal.feedback_count,
        goal.ended_at,
        goal.keep_until,
        bool(goal.goal),  # its request, which only a goal that was given up has still
    )


def encode_row(number: int, records: list[Record]) -> bytes:
    """Return the bytes of a row."""
    data = _encode(records)
    return _checksum(number, data) + data


def decode_row(number: int, row: bytes) -> list[Record]:
    """Return the records of a row.

    Raises:
        DamagedRow: The bytes are not those that were written for that number.
    """
    data = memoryview(row)[4:]
    if row[:4] != _checksum(number, data):
        raise DamagedRow(f"row {number} is not what was written")
    try:
        return _decode(data)
    except ValueError as exc:  # as the errors of decoding are
        raise DamagedRow(f"row {number} cannot be read: {exc}") from None


def _checksum(number: int, data: bytes | memoryview) -> bytes:
    value = number & 0xFFFFFFFF
    if len(data) <= SLICE:
        return zlib.crc32(data, value).to_bytes(4, "big")
    view = memoryview(data)
    for start in range(0, len(data), SLICE):
        value = zlib.crc32(view[start : start + SLICE], value)
    return value.to_bytes(4, "big")


class ActionGoals:
    """The goals of one action, as far as its records have been read."""

    def __init__(self) -> None:
        self.active: dict[bytes, StoredGoal] = {}
        """The goals that have not ended, in the order of their acceptance."""
        self.ended: dict[bytes, StoredGoal] = {}
        """The goals that have ended, in the order of their ends."""

    def drop_expired(self, max_results: int, now: int) -> None:
        """Forget ended goals whose time has passed at `now`, and the oldest of too many; those that
        were given up are counted by themselves.
        """
        kept = [goal for goal in self.ended.values() if not 0 < goal.keep_until <= now]
        given_up, others = (
            [goal.goal_id for goal in kept if goal.is_given_up == is_given_up][::-1][:max_results]
            for is_given_up in (True, False)
        )
        newest = {*given_up, *others}
        self.ended = {goal.goal_id: goal for goal in kept if goal.goal_id in newest}

    def given_up(self, goal_id: GoalID) -> StoredGoal | None:
        """Return a goal that was given up, with all its fields; None if there is none."""
        goal = self.ended.get(goal_id)
        return goal if goal is not None and goal.is_given_up else None

    def in_order(self) -> list[StoredGoal]:
        """Return those that have ended by their ends, then the active ones by their stamps."""
        return [
            *self.ended.values(),
            *sorted(self.active.values(), key=lambda goal: goal.stamp),
        ]

    def add(self, record: WholeRecord | StateRecord | CheckpointRecord | EndRecord) -> None:
        """Apply one record."""
        if isinstance(record, WholeRecord):
            self._add_whole(record.goal)
            return
        goal = self.active.get(record.goal_id)
        if goal is None:
            return  # it has ended, which no later record changes
        if isinstance(record, StateRecord):
            goal.status = GoalStatus(record.status)
            goal.is_running = record.is_running
            goal.attempt, goal.lost = record.attempt, record.lost
            goal.began_at = record.began_at or goal.began_at
        elif isinstance(record, CheckpointRecord):
            if record.checkpoint != goal.checkpoint:
                goal.lost = 0  # as in the state that was kept: see `StoredGoal.lost`
            goal.checkpoint = record.checkpoint
        else:
            self._end(goal, record)

    def _add_whole(self, goal: StoredGoal) -> None:
        # An ID can come again when its first goal is forgotten.
        self.ended.pop(goal.goal_id, None)
        self.active.pop(goal.goal_id, None)
        goals = self.ended if goal.status.is_terminal else self.active
        goals[goal.goal_id] = goal

    def _end(self, goal: StoredGoal, end: EndRecord) -> None:
        goal.status = GoalStatus(end.status)
        goal.attempt, goal.lost = end.attempt, end.lost
        goal.result, goal.reason = end.result, end.reason
        goal.feedback_count = end.feedback_count
        goal.ended_at, goal.keep_until = end.ended_at, end.keep_until
        goal.is_running = False
        if not end.is_given_up:
            goal.drop_request()
        del self.active[goal.goal_id]
        self.ended[goal.goal_id] = goal


class KeptGoals:
    """The goals of all actions that the rows of a journal add up to."""

    def __init__(self) -> None:
        self.actions: dict[str, ActionGoals] = {}
        self._next = 0

    def read(self, number: int, row: bytes) -> None:
        """Apply one row; they come in the order of their numbers.

        Raises:
            DamagedRow: The row, or one before it, is missing or is not what was written.
        """
        records = decode_row(number, row)
        if number != self._next and not (self._next == 0 and records[:1] == [StartRecord()]):
            raise DamagedRow(f"a row before row {number} is missing")
        self._next = number + 1
        for record in records:
            if not isinstance(record, StartRecord):
                self.of(record.action).add(record)

    def of(self, action: str) -> ActionGoals:
        """Return the goals of an action."""
        goals = self.actions.get(action)
        if goals is None:
            goals = self.actions[action] = ActionGoals()
        return goals

    def rows(self, number: int) -> Iterator[bytes]:
        """Yield the first rows of a journal of these goals, the first of them with this number."""
        records: list[Record] = [StartRecord()]
        size = 0
        for action, goal in self._all():
            records.append(WholeRecord(action, goal))
            size += len(goal.goal) + len(goal.checkpoint or b"") + len(goal.result or b"") + 100
            if size >= ROW:
                yield encode_row(number, records)
                number, records, size = number + 1, [], 0
        if records:
            yield encode_row(number, records)

    def _all(self) -> Iterable[tuple[str, StoredGoal]]:
        for action, goals in self.actions.items():
            for goal in (*goals.ended.values(), *goals.active.values()):
                yield action, goal
