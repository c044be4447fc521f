"""The results that a server keeps: whose are forgotten first, and what their followers are told."""

from __future__ import annotations

import gc
from itertools import count
from weakref import ref

import pytest

from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.server.registry import kept_results
from fibaction.server.registry.goal_record import Ending, EndKind, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.words.errors import UnknownGoal
from fibaction.words.goals import GoalID, Sender

NUMBERS = count(1)


def ended(
    registry: GoalRegistry, owner: str, size: int, *, name: str = "", goal: bytes = b""
) -> GoalRecord:
    """Return a goal of that client that has ended with a result of so many bytes."""
    goal_id = GoalID(next(NUMBERS).to_bytes(16, "big"))
    registry.admit(goal_id, goal, now=0.0)
    record = registry.prepare(goal_id, stamp=1, sender=Sender(name, owner.encode()))
    registry.accept(record)
    registry.execute(record)
    outcome = registry.outcome_for(record, Ending(EndKind.RESULT, bytes(size)), stamp=1)
    registry.finish(record, outcome, now=0.0)
    return record


def followed(record: GoalRecord) -> FeedbackCursor:
    """Return a stream of an ended goal, whose log has nothing else."""
    log = FeedbackLog(record)
    assert record.held is not None
    record.held.log = ref(log)
    return log.follow(feedback=False)


def unread(registry: GoalRegistry, owner: str, size: int, *, name: str = "") -> FeedbackCursor:
    """Return the stream of a goal that has ended, and is forgotten but for the stream."""
    record = ended(registry, owner, size, name=name)
    stream = followed(record)
    registry.expire(1e9)
    assert record.held is None
    return stream


def is_lost(stream: FeedbackCursor) -> bool:
    try:
        return stream.known_outcome() is None
    except UnknownGoal:
        return True


def active(registry: GoalRegistry, size: int) -> None:
    registry.admit(GoalID(next(NUMBERS).to_bytes(16, "big")), bytes(size), now=0.0)


def test_the_oldest_result_of_the_client_that_holds_most_is_forgotten_first() -> None:
    registry = GoalRegistry(max_bytes=100)
    few = [ended(registry, "few", 20) for _ in range(2)]
    many = [ended(registry, "many", 20) for _ in range(4)]
    assert registry.expire(0.0) == [many[0].goal_id]
    assert all(goal.outcome for goal in few)


def test_a_token_whose_clients_hold_most_together_gives_way_first() -> None:
    registry = GoalRegistry(max_bytes=100)
    ended(registry, "alone", 30, name="alone")
    several = [ended(registry, owner, 20, name="several") for owner in "abcd"]
    assert registry.expire(0.0) == [several[0].goal_id]


@pytest.mark.promise("RESULT-9")
def test_unread_results_are_lost_when_they_are_too_large_together() -> None:
    registry = GoalRegistry(max_bytes=100)
    few = [unread(registry, "few", 20) for _ in range(2)]
    many = [unread(registry, "many", 20) for _ in range(4)]
    registry.expire(0.0)
    assert [is_lost(stream) for stream in few] == [False] * 2
    assert [is_lost(stream) for stream in many] == [True, False, False, False]
    with pytest.raises(UnknownGoal):
        many[0].take()
    assert registry.budget.used == registry.results.unread_size == 100
    assert "has not read results of 60 bytes" in registry.results.busy_for(b"many")


def test_results_that_no_stream_has_go_before_those_that_are_unread() -> None:
    registry = GoalRegistry(max_bytes=100)
    streams = [unread(registry, "a", 30) for _ in range(2)]
    kept = [ended(registry, "a", 30) for _ in range(2)]
    assert registry.expire(0.0) == [kept[0].goal_id]
    assert not any(map(is_lost, streams))


def test_the_result_that_came_last_stays_whatever_its_size() -> None:
    registry = GoalRegistry(max_bytes=10)
    stream = unread(registry, "a", 5)
    last = unread(registry, "a", 1000)
    registry.expire(0.0)
    assert (is_lost(stream), is_lost(last)) == (True, False)
    assert registry.budget.used == 1000


def test_goals_take_the_room_of_kept_results_and_half_of_that_of_unread_ones() -> None:
    registry = GoalRegistry(max_bytes=100)
    streams = [unread(registry, "a", 20) for _ in range(4)]
    kept = ended(registry, "b", 10)
    active(registry, 100)
    assert registry.busy == ""
    assert registry.expire(0.0) == [kept.goal_id]
    assert [is_lost(stream) for stream in streams] == [True, True, False, False]
    assert registry.budget.used == 140


def test_a_client_that_leaves_half_of_the_bytes_unread_is_busy_and_others_are_not() -> None:
    registry = GoalRegistry(max_bytes=100)
    streams = [unread(registry, "a", 25) for _ in range(2)]
    assert registry.results.busy_for(b"a") == ""
    streams.append(unread(registry, "a", 1))
    assert registry.results.busy_for(b"a") == (
        "busy: its client has not read results of 51 bytes, the limit is 50"
    )
    assert registry.results.busy_for(b"b") == ""


def test_one_call_loses_a_limited_number_of_unread_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(kept_results, "MOST_LOST", 3)
    registry = GoalRegistry(max_bytes=10)
    streams = [unread(registry, "a", 1) for _ in range(10)]
    streams.append(unread(registry, "a", 9))  # which is the first of the calls
    lost = []
    for _ in range(3):
        lost.append(sum(map(is_lost, streams)))
        registry.expire(0.0)
    assert lost == [3, 6, 9]
    assert registry.budget.used == 10


def test_what_a_log_has_beside_the_result_counts_with_it_for_the_same_client() -> None:
    registry = GoalRegistry(max_bytes=100)
    record = ended(registry, "a", 10)
    held = record.held
    assert held is not None
    held.resize(40)
    assert held.share is not None
    assert held.share.size == 40
    assert (registry.budget.used, registry.results.size, registry.results.unread_size) == (
        40,
        40,
        0,
    )
    registry.expire(1e9)
    held.resize(30)
    assert (registry.budget.used, registry.results.size, registry.results.unread_size) == (
        (30,) * 3
    )
    held.drop()  # it has no log
    del held
    assert (registry.budget.used, registry.results.size, registry.results.unread_size) == ((0,) * 3)


def test_bytes_that_are_collected_before_the_log_that_is_part_of_them_count_once() -> None:
    registry = GoalRegistry(max_bytes=100)
    record = ended(registry, "a", 10)
    log = FeedbackLog(record, payload=bytes(5))
    log.finish()
    assert (registry.budget.used, registry.results.size) == (15, 15)
    # Of a cycle of garbage, what was made first is finalized first.
    cycle: list[object] = [record.held, log]
    cycle.append(cycle)
    registry.expire(1e9)
    del record, log, cycle
    gc.collect()
    assert (registry.budget.used, registry.results.size, registry.results.unread_size) == ((0,) * 3)
