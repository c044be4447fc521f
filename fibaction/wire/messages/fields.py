"""The base of all messages, the types of their fields, and the messages of both sides."""

from __future__ import annotations

from typing import Annotated, TypeAlias, final

import msgspec

from fibaction._runtime.text import shortened
from fibaction.words.goal_query import MAX_WORDS, MOST_PAST, GoalQuery, PastPage
from fibaction.words.goals import GoalID, Parent
from fibaction.words.meta import LONGEST_STEP, MAX_KEYS, Meta, fitting
from fibaction.words.statuses import GoalStatus

VERSION = 1
"""Version of the protocol. A peer of another version is rejected."""
LARGEST = 2**63 - 1
"""Largest number that a message can contain; as a stamp, later than every goal."""

ID: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
"""ID of a request and of all messages that belong to it; the client uses each number once."""
GoalBytes: TypeAlias = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
ParentFields: TypeAlias = tuple[GoalBytes, str]
"""ID of the goal whose executor has sent another one, and the name of the step that this is."""
Stamp: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=LARGEST)]
AttemptNumber: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=LARGEST)]
Count: TypeAlias = Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
FrameSize: TypeAlias = Annotated[int, msgspec.Meta(ge=1, lt=2**32)]
LONGEST_HEARTBEAT = 3600.0
"""Longest heartbeat that a message can contain, in seconds."""
Seconds: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_HEARTBEAT)]
LONGEST_TIMEOUT = 1e9
"""Longest timeout of a goal that a message can contain, in seconds: about 30 years."""
Timeout: TypeAlias = Annotated[float, msgspec.Meta(gt=0, le=LONGEST_TIMEOUT)]


PastFields: TypeAlias = tuple[
    list[GoalStatus], str, Stamp | None, Stamp | None, Count, tuple[Stamp, GoalBytes] | None, bool
]
"""A page of a history: the statuses that are listed, none for any; a part of the client's name;
earliest and latest stamp; number of goals; stamp and ID of the goal before the first one; and
whether the newest goals come first."""


LabelFields: TypeAlias = Annotated[list[tuple[str, str]], msgspec.Meta(max_length=MAX_KEYS)]
"""Keys and values of labels that goals are to have."""

WordFields: TypeAlias = Annotated[list[str], msgspec.Meta(max_length=MAX_WORDS)]
"""Words that the texts of goals are to have."""


class WireMessage(msgspec.Struct, array_like=True, gc=False):
    """Base of all messages. A message cannot be part of a cycle: it needs no garbage collector."""


@final
class Ping(WireMessage, tag=0):
    """Heartbeat of a side that has nothing else to send. Not answered."""


@final
class Goodbye(WireMessage, tag=1):
    """Last message of a side, with the reason why it closes the connection. Not answered."""

    reason: str
    why: int = 0
    """One of the `Why` numbers; 0 if there is no error."""


def parent_fields(parent: Parent | None) -> ParentFields | None:
    """Return the parent of a goal as the field of a message."""
    # `bytes`, because other classes take several times as long to encode.
    return None if parent is None else (bytes(parent.goal_id), parent.step)


def parent_from(fields: ParentFields | None) -> Parent | None:
    """Return the parent of a goal that the field of a message names."""
    return None if fields is None else Parent(GoalID(fields[0]), shortened(fields[1], LONGEST_STEP))


def told_labels(labels: Meta) -> dict[str, str] | None:
    """Return the labels of a goal as the field of a message; None if there are none."""
    return fitting(labels) if labels else None


def labels_from(field: dict[str, str] | None) -> dict[str, str]:
    """Return the labels of a goal that the field of a message has, as far as they are allowed."""
    return fitting(field) if field else {}


def past_fields(page: PastPage) -> PastFields:
    """Return a page of a history as the field of a message."""
    wanted, after = page.wanted, page.after
    return (
        sorted(wanted.statuses),
        wanted.client,
        _stamp(wanted.since),
        _stamp(wanted.until),
        min(page.limit, MOST_PAST),
        None if after is None or after[0] < 0 else (min(after[0], LARGEST), bytes(after[1])),
        page.newest_first,
    )


def label_fields(page: PastPage) -> LabelFields | None:
    """Return the labels of the goals on a page as the field of a message; None if there are none.
    No goal has more labels than can be sent.
    """
    return list(dict.fromkeys(page.wanted.labels))[:MAX_KEYS] or None


def word_fields(page: PastPage) -> WordFields | None:
    """Return the words of the goals on a page as the field of a message; None if there are none."""
    return list(page.wanted.words[:MAX_WORDS]) or None


def past_from(
    fields: PastFields, labels: LabelFields | None = None, words: WordFields | None = None
) -> PastPage:
    """Return the page of a history that the fields of a message ask for."""
    statuses, client, since, until, limit, after, newest_first = fields
    wanted = GoalQuery(
        frozenset(statuses), client, since, until, tuple(labels or ()), tuple(words or ())
    )
    return PastPage(wanted, limit, after, newest_first)


def _stamp(time: int | None) -> int | None:
    return None if time is None else min(max(time, 0), LARGEST)
