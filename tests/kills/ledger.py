"""The ledger of all that clients were told and executors did, with the contradictions in it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

from fibaction import GoalID, GoalStatus, Outcome
from tests.kills.victim import TOO_HARD, Done, Entry, Work

RESTARTED = "the server was restarted"
GIVEN_UP = f"given up after {{}} attempts: {RESTARTED}"


class Told:
    """All that clients were told of a goal after its acceptance."""

    def __init__(self, work: Work, stamp: int) -> None:
        self.work = work
        self.stamp = stamp
        self.canceled_at: int | None = None
        """Time at which the acceptance of a cancel was told: see `Entry.at`."""
        self.asked_to_cancel = False
        """True if a cancel was sent, whose answer may have been lost."""
        self.outcomes: list[Outcome[Done]] = []
        """The ends that were told, of which there is one for each that followed the goal."""


class Ledger:
    """The goals whose acceptance was told, and everything that has gone wrong for a client."""

    def __init__(self) -> None:
        self.goals: dict[GoalID, Told] = {}
        self.faults: list[str] = []
        self.calls: Counter[str] = Counter()
        """The number of calls of clients, by their names."""

    def note_acceptance(self, goal_id: GoalID, work: Work, stamp: int) -> Told:
        """Note an acceptance, which is the same each time that it is told."""
        told = self.goals.setdefault(goal_id, Told(work, stamp))
        if told.stamp != stamp:
            self.faults.append(f"{goal_id} was accepted at {told.stamp}, and at {stamp}")
        return told

    def ends(self) -> Counter[str]:
        """Return the number of goals by status and reason."""
        return Counter(
            f"{told.outcomes[-1].status.name} {told.outcomes[-1].reason}".strip()
            for told in self.goals.values()
            if told.outcomes
        )


class Rules(NamedTuple):
    """The rules of the server, against which the ledger is compared."""

    rerun: bool
    max_attempts: int

    def is_loss(self, reason: str) -> bool:
        """Return whether a goal may end with this reason because its process was lost."""
        return reason == (GIVEN_UP.format(self.max_attempts) if self.rerun else RESTARTED)


def faults_of(ledger: Ledger, diary: Iterable[Entry], rules: Rules) -> Iterator[str]:
    """Yield each broken promise as a line."""
    yield from ledger.faults
    done = entries_by_goal(diary)
    most_lost = rules.max_attempts if rules.rerun else 1
    for goal_id, told in ledger.goals.items():
        entries = done[str(goal_id)]
        faults = (
            *faults_of_end(told, rules.is_loss),
            *faults_of_attempts(told, entries, most_lost),
        )
        yield from (f"{goal_id} {fault}" for fault in faults)


def entries_by_goal(diary: Iterable[Entry]) -> defaultdict[str, list[Entry]]:
    """Return the entries of each goal, in their order."""
    done: defaultdict[str, list[Entry]] = defaultdict(list)
    for entry in diary:
        done[entry.goal_id].append(entry)
    return done


def faults_of_end(told: Told, is_loss: Callable[[str], bool]) -> Iterator[str]:
    """Yield what is wrong with the ends that were told; `is_loss` says which reasons a goal may
    have that was lost.
    """
    if not told.outcomes:
        yield "was accepted, and its end was never told"
        return
    outcome = told.outcomes[0]
    if any(other != outcome for other in told.outcomes):
        yield f"was told to have ended as {' and as '.join(map(str, told.outcomes))}"
    match outcome:
        case Outcome(GoalStatus.SUCCEEDED, Done(steps), ""):
            if told.work.fails or steps != told.work.steps:
                yield f"succeeded with {steps} of {told.work.steps} steps"
        case Outcome(GoalStatus.CANCELED):
            if not told.asked_to_cancel:
                yield "was canceled, and no client asked for it"
        case Outcome(GoalStatus.ABORTED, Done(steps), reason) if reason == TOO_HARD:
            if not told.work.fails or steps != told.work.steps:
                yield f"gave up after {steps} of {told.work.steps} steps"
        case Outcome(GoalStatus.ABORTED, None, reason) if is_loss(reason):
            if told.canceled_at is not None:
                yield "was aborted as lost, although a client was told that it is canceled"
        case _:
            yield f"ended as {outcome}"


def faults_of_attempts(told: Told, entries: Iterable[Entry], most_lost: float) -> Iterator[str]:
    """Yield what is wrong with the attempts at a goal, of which so many may be lost without
    progress.
    """
    attempt, kept, lost = 0, 0, 0
    for entry in entries:
        match entry.what:
            case "began":
                lost += entry.attempt - attempt - (attempt == 0)
                if entry.steps > kept and attempt:
                    # The attempt before was killed when the checkpoint was kept, and not noted yet.
                    kept, lost = entry.steps, 1
                if lost >= most_lost:
                    yield f"was run again after {lost} attempts were lost without progress"
                if entry.attempt <= attempt:
                    yield f"began attempt {entry.attempt} after attempt {attempt}"
                if entry.steps < kept:
                    yield f"began again with {entry.steps} steps, although {kept} were kept"
                if told.canceled_at is not None and entry.at > told.canceled_at:
                    yield "was run again, although a client was told that it is canceled"
                attempt = entry.attempt
            case _ if entry.attempt < attempt:
                yield f"took a step in attempt {entry.attempt} after attempt {attempt} had begun"
            case "kept":
                kept, lost = entry.steps, 0


def attempts_of(diary: Iterable[Entry]) -> Mapping[int, int]:
    """Return the number of goals by the number of attempts that an executor has begun."""
    attempts: dict[str, int] = {}
    for entry in diary:
        attempts[entry.goal_id] = max(entry.attempt, attempts.get(entry.goal_id, 0))
    return dict(sorted(Counter(attempts.values()).items()))
