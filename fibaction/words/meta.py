"""The meta of a goal: a small text map next to it, for traces, the parent of a goal, and labels."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from fibaction._runtime.text import shortened
from fibaction.words.errors import InvalidMessage
from fibaction.words.goals import GoalID, Parent

Meta: TypeAlias = Mapping[str, str]
"""A small text map that goes with a goal: the keys `traceparent`, `tracestate` and `baggage` of the
W3C, those below, and the labels of the goal. It is not part of the goal: that of a retry is
ignored."""

MAX_KEYS = 8
"""Keys of a meta, at most."""
MAX_META_BYTES = 4096
"""Bytes of all keys and values of a meta in UTF-8, at most."""

DETACHED = "detached"
"""Key of a goal whose client does not wait for it. Its trace is linked to that of the client."""

PARENT = "parent"
"""Key of a goal that the executor of another one has sent: the ID of that, as hexadecimal digits.
"""

STEP = "step"
"""Key of the name of the step that a goal is of its parent."""
LONGEST_STEP = 100
"""Characters of the name of a step that are kept and told."""

TRACE_KEYS = ("traceparent", "tracestate", "baggage")
"""Keys of the W3C: headers in HTTP, and environment variables in upper case."""

NOT_LABELS = frozenset((*TRACE_KEYS, DETACHED, PARENT, STEP))
"""Keys of a meta that are not those of labels."""

NO_META: Meta = MappingProxyType({})


def size_of(meta: Meta | None) -> int:
    """Return the bytes of a meta; 0 for None.

    Raises:
        InvalidMessage: It has too many keys or bytes, or something in it is not text.
    """
    if not meta:
        return 0
    if len(meta) > MAX_KEYS:
        raise InvalidMessage(f"the goal's meta has {len(meta)} keys, and {MAX_KEYS} are the limit")
    try:
        size = sum(len(key.encode()) + len(value.encode()) for key, value in meta.items())
    except (AttributeError, UnicodeEncodeError):
        raise InvalidMessage("the goal's meta maps text to text, and part of it is not") from None
    if size > MAX_META_BYTES:
        raise InvalidMessage(
            f"the goal's meta has {size} bytes, and {MAX_META_BYTES} are the limit"
        )
    return size


def checked_meta(meta: Meta | None) -> dict[str, str] | None:
    """Return a copy of a meta; None if it is empty.

    Raises:
        InvalidMessage: As for `size_of`.
    """
    return dict(meta) if meta and size_of(meta) else None


def fitting(meta: Meta) -> dict[str, str]:
    """Return the entries that are within the limits, one after the other; the rest is left out."""
    fits: dict[str, str] = {}
    for key, value in meta.items():
        with suppress(InvalidMessage):
            size_of({**fits, key: value})
            fits[key] = value
    return fits


def parent_in(meta: Meta | None) -> Parent | None:
    """Return the parent that a meta names; None if it names none."""
    if not meta or PARENT not in meta:
        return None
    try:
        goal_id = GoalID.parse(meta[PARENT])
    except ValueError:
        return None  # it is a key of the client's own
    return Parent(goal_id, shortened(meta.get(STEP, ""), LONGEST_STEP))


class Origin(NamedTuple):
    """The origin of a goal, as its meta tells."""

    parent: Parent | None = None
    """The goal whose executor has sent it; None if there is none."""
    labels: dict[str, str] | None = None
    """The labels that its client has given it; None if there are none."""
    size: int = 0
    """The bytes of its labels."""


UNKNOWN_ORIGIN = Origin()
"""The origin of a goal without a meta."""


def origin_in(meta: Meta | None) -> Origin:
    """Return the origin of a goal that a meta within the limits tells."""
    if not meta:
        return UNKNOWN_ORIGIN
    labels = labels_in(meta) or None
    return Origin(parent_in(meta), labels, size_of(labels))


def meta_of_child(parent: Parent, meta: Meta = NO_META) -> dict[str, str]:
    """Return the meta of a goal that has a parent: another meta, as far as both fit."""
    return fitting({PARENT: str(parent.goal_id), **meta, STEP: parent.step})


def labels_in(meta: Meta | None) -> dict[str, str]:
    """Return the labels of a goal: the entries of its meta by which people find the goal again."""
    return {key: meta[key] for key in meta if key not in NOT_LABELS} if meta else {}


def with_labels(labels: Mapping[str, str], meta: Meta = NO_META) -> dict[str, str]:
    """Return the meta of a goal with labels: another meta, as far as both fit.

    Raises:
        ValueError: A label has the key of something else.
        InvalidMessage: As for `size_of`.
    """
    for key in labels:
        check_is_label_key(key)
    size_of(labels)
    return fitting({**labels, **meta})


def check_is_label_key(key: str) -> None:
    """Check the key of a label.

    Raises:
        ValueError: It is the key of something else in a meta.
    """
    if key in NOT_LABELS:
        raise ValueError(f"{key!r} is not the key of a label: it has a meaning of its own")


def meta_after_end(meta: Meta | None) -> dict[str, str] | None:
    """Return what is kept of the meta of a goal that has ended: its parent and its labels; None if
    it has none.
    """
    parent, labels = parent_in(meta), labels_in(meta)
    return (labels or None) if parent is None else meta_of_child(parent, labels)


def trace_meta(headers: Mapping[str, str], *, is_detached: bool) -> dict[str, str]:
    """Return the meta for a goal, as far as it fits: the headers of a trace, whose names are in
    lower case, and whether the client does not wait for the goal.
    """
    meta = {DETACHED: "1"} if is_detached else {}
    return fitting(meta | {key: headers[key] for key in TRACE_KEYS if key in headers})
