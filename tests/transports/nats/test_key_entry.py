"""The record of a key: who has its places, and who is next."""

from __future__ import annotations

import pytest

from fibaction.words.errors import ProtocolError
from fibaction_transports.nats.records import encode
from fibaction_transports.nats.worker.key_entry import (
    Demand,
    KeyEntry,
    KeyShare,
    given,
    key_entry,
    next_entry,
)

KEY = b"left"


def share(name: str, count: int = 1) -> KeyShare:
    return KeyShare(name, name.encode(), count)


def wants(name: str, running: int = 0, asked: int = 1) -> Demand:
    return Demand(name, name.encode(), running, asked)


def holders(entry: KeyEntry) -> dict[str, int]:
    return {one.worker: one.count for one in entry.holders}


def queue(entry: KeyEntry) -> list[tuple[str, int]]:
    return [(one.worker, one.count) for one in entry.waiting]


def test_a_free_place_is_given_at_once() -> None:
    entry = next_entry(KeyEntry(KEY), wants("a", asked=3), set(), 2, gives=True)
    assert (holders(entry), queue(entry)) == ({"a": 2}, [("a", 1)])


def test_places_are_given_by_turns() -> None:
    entry = KeyEntry(KEY, (share("a"),), (share("b", 2), share("c", 2)))
    entry = next_entry(entry, wants("a"), set(), 3, gives=True)
    assert (holders(entry), queue(entry)) == (
        {"a": 1, "b": 1, "c": 1},
        [("b", 1), ("c", 1)],
    )


def test_a_worker_that_ends_a_goal_stands_behind_the_others() -> None:
    entry = KeyEntry(KEY, (share("a"),), (share("b"),))
    after = next_entry(entry, wants("a"), set(), 1, gives=True)
    assert (holders(after), queue(after)) == ({"b": 1}, [("a", 1)])
    assert given(entry, after) == ["b"]


def test_a_worker_that_waits_keeps_its_turn_when_it_wants_more() -> None:
    entry = KeyEntry(KEY, (share("z"),), (share("a"), share("b")))
    assert queue(next_entry(entry, wants("a", asked=5), set(), 1, gives=True)) == [
        ("a", 5),
        ("b", 1),
    ]


def test_a_worker_that_wants_nothing_is_not_in_the_record() -> None:
    entry = KeyEntry(KEY, (share("a"),), (share("a"), share("b")))
    after = next_entry(entry, wants("a", asked=0), set(), 1, gives=True)
    assert (holders(after), queue(after)) == ({"b": 1}, [])
    assert next_entry(after, wants("b", asked=0), set(), 1, gives=True).is_empty


def test_workers_that_are_gone_are_left_out() -> None:
    entry = KeyEntry(KEY, (share("a"),), (share("b"), share("c")))
    after = next_entry(entry, wants("c"), {b"a", b"b"}, 1, gives=True)
    assert (holders(after), queue(after)) == ({"c": 1}, [])


def test_goals_that_run_are_written_also_above_the_limit_and_then_nobody_gets_a_place() -> None:
    entry = KeyEntry(KEY, (share("b"),), (share("c"),))
    after = next_entry(entry, wants("a", running=1, asked=0), set(), 1, gives=True)
    assert (holders(after), queue(after)) == ({"a": 1, "b": 1}, [("c", 1)])
    after = next_entry(after, wants("b", asked=0), set(), 1, gives=True)
    assert (holders(after), queue(after)) == ({"a": 1}, [("c", 1)])


def test_in_a_new_stream_nobody_gets_a_place() -> None:
    entry = next_entry(KeyEntry(KEY), wants("a"), set(), 1, gives=False)
    assert (holders(entry), queue(entry), entry.gives_none) == ({}, [("a", 1)], True)
    assert key_entry(encode(entry)) == entry


def test_another_record_is_an_error() -> None:
    with pytest.raises(ProtocolError, match="the record of places of a key"):
        key_entry(b"\xc1")
