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


def counts(shares: tuple[KeyShare, ...]) -> dict[str, int]:
    return {one.worker: one.count for one in shares}


A, B, C = share("a"), share("b"), share("c")


@pytest.mark.parametrize(
    ("before", "demand", "gone", "most", "holders", "queue"),
    [
        pytest.param(((), ()), wants("a", asked=3), "", 2, {"a": 2}, {"a": 1}, id="free"),
        pytest.param(
            ((A,), (share("b", 2), share("c", 2))),
            wants("a"),
            "",
            3,
            {"a": 1, "b": 1, "c": 1},
            {"b": 1, "c": 1},
            id="by turns",
        ),
        pytest.param(
            ((A,), (B,)), wants("a"), "", 1, {"b": 1}, {"a": 1}, id="behind the others after an end"
        ),
        pytest.param(
            ((share("z"),), (A, B)),
            wants("a", asked=5),
            "",
            1,
            {"z": 1},
            {"a": 5, "b": 1},
            id="its turn is kept",
        ),
        pytest.param(((A,), (A, B)), wants("a", asked=0), "", 1, {"b": 1}, {}, id="no demand"),
        pytest.param(((B,), ()), wants("b", asked=0), "", 1, {}, {}, id="empty"),
        pytest.param(((A,), (B, C)), wants("c"), "ab", 1, {"c": 1}, {}, id="lost workers"),
        pytest.param(
            ((B,), (C,)),
            wants("a", running=1, asked=0),
            "",
            1,
            {"a": 1, "b": 1},
            {"c": 1},
            id="above the limit",
        ),
        pytest.param(
            ((A, B), (C,)), wants("b", asked=0), "", 1, {"a": 1}, {"c": 1}, id="down to the limit"
        ),
    ],
)
def test_places_are_given_by_turns(
    before: tuple[tuple[KeyShare, ...], tuple[KeyShare, ...]],
    demand: Demand,
    gone: str,
    most: int,
    holders: dict[str, int],
    queue: dict[str, int],
) -> None:
    entry = KeyEntry(KEY, *before)
    after = next_entry(entry, demand, {one.encode() for one in gone}, most, gives=True)
    assert (counts(after.holders), list(counts(after.waiting).items())) == (
        holders,
        list(queue.items()),
    )
    assert after.is_empty == (not holders and not queue)
    assert given(entry, after) == [one for one in holders if one not in counts(entry.holders)]


def test_in_a_new_stream_nobody_gets_a_place() -> None:
    entry = next_entry(KeyEntry(KEY), wants("a"), set(), 1, gives=False)
    assert (entry.holders, counts(entry.waiting), entry.gives_none) == ((), {"a": 1}, True)
    assert key_entry(encode(entry)) == entry


def test_another_record_is_an_error() -> None:
    with pytest.raises(ProtocolError, match="the record of slots of a key"):
        key_entry(b"\xc1")
