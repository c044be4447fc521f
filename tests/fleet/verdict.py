"""The contradictions between what clients were told, what is recorded, and what executors did."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from fibaction import GoalID
from tests.fleet.witness import Write
from tests.kills.ledger import (
    Ledger,
    Told,
    entries_by_goal,
    faults_of_attempts,
    faults_of_end,
)
from tests.kills.victim import Entry

LOST = re.compile(r"the worker '(?P<worker>.+)' was lost")


class Rules(NamedTuple):
    """The things that a scenario allows."""

    rerun: bool
    lost: frozenset[str] = frozenset()
    """The names of workers that were killed, or frozen for longer than their lease."""
    released: frozenset[str] = frozenset()
    """The names of workers that were stopped in good order."""
    limit: int = 0
    """The goals of each key that may run at the same time; 0 for any number."""

    def is_loss(self, reason: str) -> bool:
        """Return whether a goal may end with this reason because its worker was lost."""
        lost = LOST.fullmatch(reason)
        return lost is not None and not self.rerun and lost["worker"] in self.lost


class Case(NamedTuple):
    """All that is known about a run."""

    ledger: Ledger
    diary: list[Entry]
    """The entries of all workers, in the order of time."""
    writes: list[Write]
    rules: Rules
    epoch: float = 0.0
    """Time at which the clock of the diary was 0: seconds since 1970."""


def faults_of(case: Case) -> Iterator[str]:
    """Yield each contradiction as a line."""
    yield from case.ledger.faults
    done, recorded = entries_by_goal(case.diary), writes_by_goal(case.writes)
    for goal_id, told in case.ledger.goals.items():
        writes, entries = recorded.get(goal_id, []), done[str(goal_id)]
        faults = (
            *faults_of_end(told, case.rules.is_loss),
            *_faults_of_record(told, writes, case.rules),
            *faults_of_attempts(told, entries, math.inf),
            *_faults_of_runs(entries, case.rules),
            *_faults_after_end(writes, entries, case.epoch),
        )
        yield from (f"{goal_id} {fault}" for fault in faults)


class _Attempt(NamedTuple):
    """An attempt at a goal, from its begin to its last step."""

    key: int
    began: int
    ended: int


def faults_of_keys(case: Case) -> Iterator[str]:
    """Yield a line for each begin of a goal beside too many others of its key."""
    works = {str(goal_id): told.work for goal_id, told in case.ledger.goals.items()}
    attempts: dict[tuple[str, int], _Attempt] = {}
    for entry in case.diary:
        if entry.goal_id not in works or entry.what == "kept":
            continue
        one = entry.goal_id, entry.attempt
        key, began = works[entry.goal_id].key, attempts.get(one)
        attempts[one] = _Attempt(key, entry.at if began is None else began.began, entry.at)
    for (goal_id, _), attempt in attempts.items():
        beside = [
            other
            for other in attempts.values()
            if other.key == attempt.key and other.began <= attempt.began <= other.ended
        ]
        if case.rules.limit and len(beside) > case.rules.limit:
            yield f"{goal_id} began as one of {len(beside)} of key {attempt.key}"


def key_pauses(case: Case, lost: Iterable[Entry], lost_at: float) -> dict[int, float]:
    """Return the seconds from the loss of a worker, whose diary is given, to the next begin of a
    goal of each key that a goal of the worker had at that time.
    """
    works = {str(goal_id): told.work for goal_id, told in case.ledger.goals.items()}
    mine = {(entry.goal_id, entry.at) for entry in lost}
    last: dict[int, Entry] = {}
    pauses: dict[int, float] = {}
    for entry in case.diary:
        if entry.goal_id not in works:
            continue
        key, at = works[entry.goal_id].key, entry.at / 1e9 + case.epoch
        if at <= lost_at:
            last[key] = entry
        elif entry.what == "began" and key in last and (last[key].goal_id, last[key].at) in mine:
            pauses.setdefault(key, round(at - lost_at, 2))
    return pauses


def writes_by_goal(writes: Iterable[Write]) -> Mapping[GoalID, list[Write]]:
    """Return the writes of each goal, in their order."""
    found: dict[GoalID, list[Write]] = {}
    for write in writes:
        if write.goal is not None:
            found.setdefault(write.goal.goal_id, []).append(write)
    return found


def _faults_of_record(told: Told, writes: list[Write], rules: Rules) -> Iterator[str]:
    ends = [write.goal for write in writes if write.goal and write.goal.status.is_terminal]
    if len(ends) != 1:
        yield f"was recorded as ended {len(ends)} times"
    elif writes[-1].goal is not ends[0]:
        yield "was recorded again after its end"
    elif told.outcomes and told.outcomes[0].status is not ends[0].status:
        yield f"was told as {told.outcomes[0].status.name}, and recorded as {ends[0].status.name}"
    for one, other in pairwise(write.goal for write in writes):
        assert one is not None
        assert other is not None
        is_taken = one.worker and other.worker != one.worker
        if is_taken and one.worker not in rules.lost | rules.released:
            yield f"was taken from {one.worker!r} by {other.worker!r}"


def _faults_of_runs(entries: Iterable[Entry], rules: Rules) -> Iterator[str]:
    attempt = max((entry.attempt for entry in entries), default=0)
    limit = 1 + len(rules.released) + (len(rules.lost) if rules.rerun else 0)
    if attempt > limit:
        yield f"was run {attempt} times, and {limit} are allowed"


def _faults_after_end(writes: list[Write], entries: Iterable[Entry], epoch: float) -> Iterator[str]:
    ended = [write.at for write in writes if write.goal and write.goal.status.is_terminal]
    if ended and any(entry.at / 1e9 + epoch > ended[0] for entry in entries):
        yield "took a step after its end was recorded"


# Figures


def unseen(writes: Iterable[Write]) -> int:
    """Return the number of writes that are missing, because a broker was killed after them."""
    seen = {write.sequence for write in writes}
    return sum(write.replaced not in seen for write in writes if write.replaced)


def longest_pause(writes: Iterable[Write]) -> float:
    """Return the most seconds between two writes."""
    return max((other.at - one.at for one, other in pairwise(writes)), default=0.0)


def moves(writes: Iterable[Write]) -> int:
    """Return how many times a worker has taken a goal from another."""
    return sum(
        one.goal is not None and other.goal is not None and one.goal.worker != other.goal.worker
        for of_goal in writes_by_goal(writes).values()
        for one, other in pairwise(of_goal)
    )


class Handover(NamedTuple):
    """The goals that a worker had when it was lost, and the seconds until they were safe."""

    goals: int
    median: float = 0.0
    longest: float = 0.0


def handover(writes: Iterable[Write], worker: str, lost_at: float) -> Handover:
    """Return the seconds from the loss of a worker until its goals had ended or ran elsewhere."""
    seconds: list[float] = []
    for of_goal in writes_by_goal(writes).values():
        before = [write.goal for write in of_goal if write.at <= lost_at]
        if not before or before[-1] is None:
            continue
        if before[-1].worker != worker or before[-1].status.is_terminal:
            continue
        safe = (
            write.at - lost_at
            for write in of_goal
            if write.at > lost_at and write.goal and _is_safe(write, worker)
        )
        seconds.append(next(safe, float("inf")))
    if not seconds:
        return Handover(0)
    return Handover(len(seconds), round(median(seconds), 2), round(max(seconds), 2))


def _is_safe(write: Write, worker: str) -> bool:
    goal = write.goal
    assert goal is not None
    return goal.status.is_terminal or (goal.is_running and goal.worker != worker)
