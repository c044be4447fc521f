"""`fibaction.words.meta`: the limits of the text that goes with a goal."""

from __future__ import annotations

from typing import Any, cast

import pytest

from fibaction import GoalID, InvalidMessage, Parent
from fibaction.words.meta import (
    MAX_KEYS,
    MAX_META_BYTES,
    Origin,
    checked_meta,
    fitting,
    labels_in,
    meta_after_end,
    meta_of_child,
    origin_in,
    parent_in,
    size_of,
    trace_meta,
    with_labels,
)


def test_a_meta_without_entries_is_none() -> None:
    assert checked_meta(None) is None
    assert checked_meta({}) is None
    assert (size_of(None), size_of({})) == (0, 0)


def test_a_meta_at_the_limits_is_copied() -> None:
    meta = {str(number): "" for number in range(MAX_KEYS)}
    meta["0"] = "x" * (MAX_META_BYTES - MAX_KEYS)

    copy = checked_meta(meta)

    assert copy == meta
    assert copy is not meta


@pytest.mark.parametrize(
    ("meta", "text"),
    [
        ({str(number): "" for number in range(9)}, "the goal's meta has 9 keys, and 8 are the lim"),
        ({"a": "x" * 4096}, "the goal's meta has 4097 bytes, and 4096 are the limit"),
        ({"a": 1}, "the goal's meta maps text to text, and part of it is not"),
        ({b"a": "1"}, "the goal's meta maps text to text, and part of it is not"),
        ({"a": "\ud800"}, "the goal's meta maps text to text, and part of it is not"),
    ],
)
def test_what_is_wrong_is_told_in_one_sentence(meta: dict[Any, Any], text: str) -> None:
    with pytest.raises(InvalidMessage, match=text):
        checked_meta(cast("dict[str, str]", meta))


def test_what_does_not_fit_is_left_out_entry_by_entry() -> None:
    many = {str(number): "" for number in range(20)}

    assert fitting({"a": "1", "large": "x" * 5000, "b": "2"}) == {"a": "1", "b": "2"}
    assert list(fitting(many)) == list(many)[:MAX_KEYS]


def test_only_the_headers_of_a_trace_go_with_a_goal() -> None:
    headers = {"host": "robot", "traceparent": "00-1", "baggage": "x" * 4097}

    assert trace_meta(headers, is_detached=False) == {"traceparent": "00-1"}
    assert trace_meta({}, is_detached=True) == {"detached": "1"}


PARENT_ID = GoalID(bytes(range(16)))


def test_the_meta_of_a_child_names_its_parent_and_its_step_beside_the_trace() -> None:
    parent = Parent(PARENT_ID, "pick")

    meta = meta_of_child(parent, {"traceparent": "00-1"})

    assert meta == {"parent": str(PARENT_ID), "traceparent": "00-1", "step": "pick"}
    assert parent_in(meta) == parent


def test_a_step_with_a_name_that_is_too_long_leaves_the_trace_in_the_meta() -> None:
    meta = meta_of_child(Parent(PARENT_ID, "x" * MAX_META_BYTES), {"traceparent": "00-1"})

    assert meta == {"parent": str(PARENT_ID), "traceparent": "00-1"}
    assert parent_in(meta) == Parent(PARENT_ID)


def test_a_long_name_of_a_step_is_kept_and_told_in_part() -> None:
    found = parent_in({"parent": str(PARENT_ID), "step": "x" * 101})

    assert found == Parent(PARENT_ID, "x" * 99 + "…")


@pytest.mark.parametrize("meta", [None, {}, {"step": "pick"}, {"parent": "me", "step": "pick"}])
def test_a_meta_without_the_id_of_a_goal_names_no_parent(meta: dict[str, str] | None) -> None:
    assert parent_in(meta) is None
    assert meta_after_end(meta) is None


LABELS = {"order": "17", "site": "north"}


def test_the_labels_of_a_goal_are_what_has_no_other_meaning_in_its_meta() -> None:
    trace = {"traceparent": "00-1", "tracestate": "a", "baggage": "b", "detached": "1"}
    meta = meta_of_child(Parent(PARENT_ID, "pick"), {**LABELS, "traceparent": "00-1"})

    assert labels_in({**trace, **LABELS}) == LABELS
    assert origin_in(meta) == Origin(Parent(PARENT_ID, "pick"), LABELS, 16)
    assert origin_in(trace) == origin_in(None) == Origin()
    assert labels_in(None) == {}


def test_the_labels_are_left_of_the_meta_after_the_end() -> None:
    child = meta_of_child(Parent(PARENT_ID, "pick"), LABELS)

    assert meta_after_end({**LABELS, "traceparent": "00-1"}) == LABELS
    assert meta_after_end({**child, "traceparent": "00-1"}) == child


def test_a_trace_goes_with_labels_as_far_as_both_fit() -> None:
    many = {f"key{number}": "" for number in range(MAX_KEYS)}

    assert with_labels(LABELS, {"traceparent": "00-1"}) == {**LABELS, "traceparent": "00-1"}
    assert with_labels(many, {"traceparent": "00-1"}) == many
    with pytest.raises(InvalidMessage, match="9 keys, and 8 are the limit"):
        with_labels({**many, "one more": ""})
    with pytest.raises(ValueError, match=r"'step' is not the key of a label: it has a meaning of"):
        with_labels({"step": "3"})
