"""The rules that hold in a fleet whatever happens, checked over what was seen of a run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from fibaction import CancelAnswer, CancelCode, GoalID, GoalStatus, Outcome
from fibaction_transports.nats.records import GoalEntry

LATE = 0.2
"""Seconds that an executor may take to end after it was interrupted."""


@dataclass
class Stretch:
    """The time in which one executor worked on one attempt at a goal."""

    goal_id: GoalID
    process: str
    attempt: int
    restored: int
    began: float
    key: int = 0
    ended: float = math.inf
    checkpoints: list[int] = field(default_factory=list)
    """The checkpoints whose call has returned."""


@dataclass
class Told:
    """What one client was told about one of its goals."""

    goal_id: GoalID
    is_accepted: bool = False
    cancel: CancelAnswer | None = None
    """The answer to its cancel."""
    cancel_at: float = math.inf
    """Time of that answer."""
    outcome: Outcome[str] | None = None
    error: str = ""


@dataclass
class Cut:
    """The time in which a process did not reach the brokers."""

    process: str
    began: float
    ended: float


@dataclass
class Seen:
    """Everything that was seen of a run."""

    lease: float
    max_attempts: int
    most_of_key: float = math.inf
    """The number of executors that may run at the same time for each key, in the whole fleet."""
    stretches: list[Stretch] = field(default_factory=list)
    told: list[Told] = field(default_factory=list)
    cuts: list[Cut] = field(default_factory=list)
    entries: list[GoalEntry] = field(default_factory=list)
    """The records of goals that were stored, in the order of their sequences."""
    errors: list[str] = field(default_factory=list)
    """Errors in the log, and other signs of a bug."""


def violations(seen: Seen) -> Iterator[str]:
    """Yield a sentence for each rule that was broken."""
    yield from seen.errors
    entries: dict[GoalID, list[GoalEntry]] = {}
    for entry in seen.entries:
        entries.setdefault(entry.goal.goal_id, []).append(entry)
    for goal_id, history in entries.items():
        yield from _of_records(goal_id, history)
    by_goal: dict[GoalID, list[Stretch]] = {}
    for stretch in seen.stretches:
        by_goal.setdefault(stretch.goal_id, []).append(stretch)
    for goal_id, stretches in by_goal.items():
        yield from _of_executors(goal_id, stretches, seen.max_attempts)
    yield from _of_keys(seen.stretches, seen.most_of_key)
    for told in seen.told:
        yield from _of_clients(told, entries.get(told.goal_id, []))
        yield from _of_cancels(told, by_goal.get(told.goal_id, []))
    for cut in seen.cuts:
        yield from _of_a_cut(cut, seen)


def _of_records(goal_id: GoalID, history: list[GoalEntry]) -> Iterator[str]:
    ends = [entry for entry in history if entry.goal.status.is_terminal]
    if not ends:
        yield f"{goal_id}: it has never ended"
    elif len(ends) > 1 or ends[0] is not history[-1]:
        yield f"{goal_id}: something was recorded after its end"
    attempts = [entry.goal.attempt for entry in history]
    if attempts != sorted(attempts):
        yield f"{goal_id}: its attempts went back: {attempts}"


def _of_executors(goal_id: GoalID, stretches: Iterable[Stretch], most: int) -> Iterator[str]:
    kept = 0
    before: Stretch | None = None
    count = 0
    for stretch in sorted(stretches, key=lambda one: one.began):
        count += 1
        if before is not None and stretch.began < before.ended:
            yield (
                f"{goal_id}: {stretch.process} began at {stretch.began:.3f}, while"
                f" {before.process} worked on it until {before.ended:.3f}"
            )
        if before is not None and stretch.attempt <= before.attempt:
            yield f"{goal_id}: attempt {stretch.attempt} came after {before.attempt}"
        if stretch.restored < kept:
            yield f"{goal_id}: {stretch.restored} was restored, although {kept} was kept"
        kept = max(kept, *stretch.checkpoints, 0)
        before = stretch
    if count > most:
        yield f"{goal_id}: it was run {count} times, and {most} are allowed"


def _of_keys(stretches: Iterable[Stretch], most: float) -> Iterator[str]:
    running: list[Stretch] = []
    for stretch in sorted(stretches, key=lambda one: one.began):
        running = [one for one in running if one.ended > stretch.began]
        running.append(stretch)
        others = [one for one in running if one.key == stretch.key]
        if len(others) > most:
            names = ", ".join(f"{one.goal_id} at {one.process}" for one in others)
            yield f"at {stretch.began:.3f}, these goals of key {stretch.key} run: {names}"


def _of_clients(told: Told, history: list[GoalEntry]) -> Iterator[str]:
    goal_id = told.goal_id
    if told.is_accepted and not history:
        yield f"{goal_id}: an acceptance was told, and there is no record"
    if not history:
        return
    last = history[-1].goal
    outcome = told.outcome
    if (
        outcome is not None
        and outcome.status is not GoalStatus.UNKNOWN
        and (outcome.status, outcome.reason) != (last.status, last.reason)
    ):
        yield (
            f"{goal_id}: {outcome.status.name} {outcome.reason!r} was told, and"
            f" {last.status.name} {last.reason!r} is recorded"
        )
    if told.cancel is not None and told.cancel.accepted and last.status is GoalStatus.ABORTED:
        yield f"{goal_id}: a cancel was accepted, and it is ABORTED: {last.reason}"
    if told.is_accepted and told.outcome is None and not told.error:
        yield f"{goal_id}: its client was told neither the end nor an error"


def _of_cancels(told: Told, stretches: Iterable[Stretch]) -> Iterator[str]:
    """A cancel is not answered as that of an unknown or ended goal that lives."""
    if told.cancel is None or told.cancel.accepted:
        return
    code = told.cancel.return_code
    if code is CancelCode.UNKNOWN_GOAL_ID:
        yield f"{told.goal_id}: its cancel was answered {code.name}, and all records are kept"
    for stretch in stretches:
        if stretch.began > told.cancel_at:
            yield f"{told.goal_id}: its cancel was answered {code.name}, and it was run again"


def _of_a_cut(cut: Cut, seen: Seen) -> Iterator[str]:
    """A process that does not reach the brokers stops its executors before its lease ends."""
    stops_at = cut.began + seen.lease + LATE
    if cut.ended <= stops_at:
        return
    for stretch in seen.stretches:
        if stretch.process == cut.process and stretch.began < stops_at < stretch.ended:
            yield (
                f"{stretch.goal_id}: {cut.process} worked on it at {stops_at:.3f}, and has not"
                f" reached the brokers since {cut.began:.3f}"
            )
