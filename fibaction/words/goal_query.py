"""The goals of a list: `GoalQuery` says which are wanted, `GoalHistory` how long ended ones stay.

A query does not depend on where the list comes from, so the same words mean the same in a shell and
in the address of an HTTP request. The time now is an argument.
"""

from __future__ import annotations

import math
import re
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Any, NamedTuple, TypeAlias, cast

from fibaction._runtime.settings_struct import SettingsStruct
from fibaction._runtime.text import excerpt
from fibaction.words.goals import GoalInfo
from fibaction.words.meta import NOT_LABELS, check_is_label_key
from fibaction.words.plain_data import check_is_number
from fibaction.words.statuses import GoalStatus

ACTIVE = frozenset(status for status in GoalStatus if status.is_active)
ENDED = frozenset(status for status in GoalStatus if status.is_terminal)
STATUSES = {
    "active": ACTIVE,
    "ended": ENDED,
    **{status.name: frozenset((status,)) for status in (*sorted(ACTIVE), *sorted(ENDED))},
}
"""The statuses that each word for them means."""

TIME_TEXT = "^([0-9]{16,19}|[0-9]{1,9}([.][0-9]{1,9})?(s|m|min|h|d))$"
"""The pattern of the texts of a time that are not in ISO 8601: a stamp, or the time since then."""

LABEL_TEXT = f"^(?!({'|'.join(sorted(NOT_LABELS))})=)[^=]+="
"""The pattern of the text of a label: its key and its value."""

Labels: TypeAlias = tuple[tuple[str, str], ...]
"""Labels of goals, by key and value."""

CANCEL_TEXT = TIME_TEXT.replace("[0-9]{16,19}", "[0-9]{0,18}[1-9][0-9]*")
"""The same for a cancel, which takes any stamp but 0."""

MAX_WORDS = 16
"""Words of one search, at most; the others do not count."""

LAST_STAMP = 2**63 - 1
"""The largest stamp."""

_TIME = re.compile(TIME_TEXT, re.ASCII)
_SECONDS = {"s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400}
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


class GoalQuery(NamedTuple):
    """The goals of a list that are wanted; without arguments, all of them."""

    statuses: frozenset[GoalStatus] = frozenset()
    """Their statuses; empty for any."""
    client: str = ""
    """A part of the text for their client; empty for any client."""
    since: int | None = None
    """The earliest time of their acceptance: nanoseconds since 1970; None for any."""
    until: int | None = None
    """The latest time of their acceptance: nanoseconds since 1970; None for any."""
    labels: Labels = ()
    """Keys and values of labels that they have, each of these; empty for any labels."""
    words: tuple[str, ...] = ()
    """Words in lower case that `text_of` each of them has, each of these; empty for any text."""

    def has(self, info: GoalInfo) -> bool:
        """Return whether a goal is wanted."""
        return (
            (not self.statuses or info.status in self.statuses)
            and (self.since is None or info.stamp >= self.since)
            and (self.until is None or info.stamp <= self.until)
            and self.client in info.client
            and all(info.labels.get(key) == value for key, value in self.labels)
            and (not self.words or _has_words(text_of(info), self.words))
        )

    def at(self, action: str) -> GoalQuery:
        """Return the query for the goals of one action, whose name may have some of the words."""
        name = action.lower()
        return self._replace(words=tuple(word for word in self.words if word not in name))


ANY_GOAL = GoalQuery()
"""The query that finds every goal."""

Place: TypeAlias = tuple[int, bytes]
"""The place of a goal in the order of acceptance: its stamp and its ID."""


def place_of(info: GoalInfo) -> Place:
    """Return the place of a goal in the order of acceptance."""
    return info.stamp, bytes(info.goal_id)


MOST_PAST = 1000
"""Goals of one page of a history, at most."""


class PastPage(NamedTuple):
    """A part of the history of a server: goals that have ended, as its store has kept them."""

    wanted: GoalQuery = ANY_GOAL
    """The goals that are listed."""
    limit: int = MOST_PAST
    """The number of goals, `MOST_PAST` at most; fewer come only at the end of the history."""
    after: Place | None = None
    """The place of the goal that comes before the first one, in the order of the page; None to
    begin with the first goal of all."""
    newest_first: bool = True
    """True for the order from the newest acceptance to the oldest, False for the other one."""

    def has(self, info: GoalInfo) -> bool:
        """Return whether a goal is on this page or on one after it."""
        if not (info.status.is_terminal and self.wanted.has(info)):
            return False
        if self.after is None:
            return True
        place = place_of(info)
        return place < self.after if self.newest_first else place > self.after


async def read_pages(
    past_goals: Callable[[PastPage], Awaitable[list[GoalInfo]]],
    wanted: GoalQuery,
    take: Callable[[list[GoalInfo]], None],
) -> None:
    """Call `take` with each page of a history, from the newest acceptance to the oldest."""
    page = PastPage(wanted)
    while infos := await past_goals(page):
        take(infos)
        if len(infos) < MOST_PAST:
            return
        page = page._replace(after=(infos[-1].stamp, bytes(infos[-1].goal_id)))


SORTS: dict[str, Callable[[GoalInfo], Any]] = {
    "accepted": lambda info: info.stamp,
    "began": lambda info: info.began_at,
    "ended": lambda info: info.ended_at,
    "waited": lambda info: info.waited,
    "ran": lambda info: info.ran,
    "status": lambda info: info.status,
    "client": lambda info: info.client,
    "worker": lambda info: info.worker,
}
"""The keys by which a list can be sorted; a key is None if it is not known of a goal."""


def sort_key(sort: str, info: GoalInfo) -> tuple[bool, Any, int, bytes]:
    """Return the place of a goal in a list that is sorted so. Goals whose key is not known come
    first, and those with the same key are in the order of their acceptance.
    """
    key = SORTS[sort](info)
    return key is not None, key, *place_of(info)


def words_of(text: str) -> tuple[str, ...]:
    """Return the words of a search as `GoalQuery` has them."""
    return tuple(dict.fromkeys(text.lower().split()))[:MAX_WORDS]


def text_of(info: GoalInfo) -> str:
    """Return the text of a goal in which a search looks, in lower case: all that a list tells of it
    but its times and numbers.
    """
    labels = [f"{key}={value}" for key, value in info.labels.items()]
    parent = () if info.parent is None else (str(info.parent.goal_id), info.parent.step)
    parts = (str(info.goal_id), info.status.name, info.client, info.worker, info.reason)
    return "\n".join((*parts, *labels, *parent)).lower()


def _has_words(text: str, words: tuple[str, ...]) -> bool:
    return all(word in text for word in words)


def label_of(text: str) -> tuple[str, str]:
    """Return the key and the value of the label that a text means, such as `order=17`. The value
    may be empty, and may have a `=` of its own.

    Raises:
        ValueError: It means none.
    """
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise ValueError(f"{excerpt(text)!r} is not a label: it is KEY=VALUE, as in order=17")
    check_is_label_key(key)
    return key, value


def time_of(text: str, now: int, *, is_local: bool) -> int:
    """Return the time that a text means, in nanoseconds since 1970: a time of ISO 8601, a stamp, or
    a time before `now`, such as `10m` for ten minutes.

    A time of ISO 8601 without a zone is in that of this machine if `is_local`, else in UTC.

    Raises:
        ValueError: It means none; the error says what does.
    """
    found = _TIME.fullmatch(text)
    if found is None:
        return _iso_time(text, is_local=is_local)
    unit = found[3]
    if unit is None:
        return int(text)
    return now - int(Decimal(text.removesuffix(unit)) * _SECONDS[unit] * 10**9)


def cancel_stamp_of(text: str, now: int, *, is_local: bool) -> int:
    """Return the stamp for a cancel of the goals that were accepted at the time that a text means,
    or earlier: a time as for `time_of`, or a stamp of any length.

    Raises:
        ValueError: It means none, or it is the stamp 0, which would mean all goals.
    """
    if not (text.isascii() and text.isdecimal()):
        time = max(time_of(text, now, is_local=is_local), 1)
    elif not (time := int(text[:20])):
        raise ValueError("a stamp of 0 means all goals: cancel all of them without a time")
    return min(time, LAST_STAMP)


def _iso_time(text: str, *, is_local: bool) -> int:
    try:
        if text.isdecimal():
            raise ValueError  # a date without its dashes looks like a number of seconds
        when = datetime.fromisoformat(text)
        if when.tzinfo is None:
            when = when.astimezone() if is_local else when.replace(tzinfo=UTC)
    except (ValueError, OverflowError, OSError):  # the last two: too far from now for the zone
        raise ValueError(
            f"{excerpt(text)!r} is not a time: it is as in 2026-01-31T12:00:00Z, or 10m for ten"
            " minutes ago, or nanoseconds since 1970"
        ) from None
    return (when - _EPOCH) // _MICROSECOND * 1000


SECOND = 1_000_000_000
DAY = 24 * 3600.0


class GoalHistory(SettingsStruct, frozen=True, kw_only=True):
    """The bounds of a history: goals that have ended stay in the store until one is passed.

    For example:

        SqliteStore("goals.db", history=GoalHistory(seconds=7 * 24 * 3600, goals=10_000))
    """

    seconds: float = 30 * DAY
    """Seconds after its end for which a goal is kept; `math.inf` without this bound."""
    goals: int = 10_000
    """The number of goals that are kept, of all actions in the store together; those whose end is
    the longest ago go first."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: One of them is not a number.
            ValueError: One of them is out of range.
        """
        check_is_number("seconds", self.seconds)
        if not self.seconds > 0:
            raise ValueError(f"seconds must be more than 0, not {self.seconds}")
        goals = cast("object", self.goals)
        if not isinstance(goals, int):
            raise TypeError(f"goals must be a whole number, not {goals!r}")
        if goals < 1:
            raise ValueError(f"goals must be 1 or more, not {goals}")

    def earliest_end(self, now: int) -> int:
        """Return the time at or before which an end is too long ago at `now`, both in nanoseconds
        since 1970; -1 if no end is.
        """
        return -1 if math.isinf(self.seconds) else now - int(self.seconds * SECOND)


def check_is_history(value: object) -> None:
    """Raise TypeError for what is neither a history nor None."""
    if not (value is None or isinstance(value, GoalHistory)):
        raise TypeError(f"history must be a GoalHistory, not {value!r}")
