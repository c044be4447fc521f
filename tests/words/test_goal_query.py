"""`fibaction.words.goal_query`: which goals are wanted and kept, and texts of times."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fibaction import GoalID, GoalInfo, GoalStatus
from fibaction.words import goal_query
from fibaction.words.goal_query import (
    LABEL_TEXT,
    MAX_WORDS,
    SECOND,
    SORTS,
    STATUSES,
    GoalHistory,
    GoalQuery,
    PastPage,
    cancel_stamp_of,
    check_is_history,
    label_of,
    sort_key,
    time_of,
    words_of,
)
from fibaction.words.goals import Parent

NOW = 1_800_000_000 * 10**9
NOON = 1_769_860_800 * 10**9
"""2026-01-31T12:00:00Z."""


def info(
    status: GoalStatus = GoalStatus.EXECUTING,
    stamp: int = NOW,
    client: str = "robot7 at 10.0.0.7:4",
) -> GoalInfo:
    return GoalInfo(GoalID(b"\x01" * 16), stamp, status, client=client)


def test_without_arguments_every_goal_is_wanted() -> None:
    assert all(GoalQuery().has(info(status, client="")) for status in GoalStatus)


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["active"], "ACCEPTED EXECUTING CANCELING"),
        (["ended"], "SUCCEEDED CANCELED ABORTED"),
        (["EXECUTING", "ABORTED"], "EXECUTING ABORTED"),
    ],
)
def test_words_mean_statuses(words: list[str], wanted: str) -> None:
    one = GoalQuery(frozenset[GoalStatus]().union(*(STATUSES[word] for word in words)))
    assert [status.name for status in GoalStatus if one.has(info(status))] == wanted.split()


def test_every_status_of_a_goal_has_its_word() -> None:
    assert {name for name in STATUSES if name.isupper()} == {
        status.name for status in GoalStatus if status is not GoalStatus.UNKNOWN
    }


def test_both_ends_of_a_span_of_time_are_within_it() -> None:
    span = GoalQuery(since=NOW, until=NOW + 2)
    found = [stamp - NOW for stamp in range(NOW - 1, NOW + 4) if span.has(info(stamp=stamp))]
    assert found == [0, 1, 2]


def test_each_word_of_a_search_is_in_the_text_of_a_goal() -> None:
    parent = Parent(GoalID(bytes(15) + b"\x0b"), "Weld")
    one = GoalInfo(
        *(GoalID(b"\xab" * 16), NOW, GoalStatus.ABORTED),
        client="ann at 10.0.0.7",
        parent=parent,
        reason="Gripper OPEN",
        labels={"order": "17"},
        worker="cell3",
    )

    def finds(text: str, action: str = "arm/pick") -> bool:
        return GoalQuery(words=words_of(text)).at(action).has(one)

    for text in ("abab", "aborted", "ANN", "order=17", "gripper open", "weld", "cell3", "0b", ""):
        assert finds(text)
    assert finds("PICK aborted pick")
    assert not finds("pick drive")
    assert not finds("open closed")
    assert len(words_of(" ".join(map(str, range(99))))) == MAX_WORDS


def test_a_list_is_sorted_with_what_is_not_known_first_and_then_by_acceptance() -> None:
    goals = [
        info(GoalStatus.EXECUTING, 4),
        replace(info(GoalStatus.SUCCEEDED, 3), began_at=3, ended_at=5),
        replace(info(GoalStatus.SUCCEEDED, 2), began_at=3, ended_at=9),
        replace(info(GoalStatus.SUCCEEDED, 1), began_at=3, ended_at=5),
    ]
    found = sorted(goals, key=lambda one: sort_key("ran", one))
    assert [one.stamp for one in found] == [4, 1, 3, 2]
    assert all(sort_key(name, goals[1]) for name in SORTS)


def test_a_page_of_the_past_has_the_goals_that_are_wanted_after_its_place() -> None:
    wanted = GoalQuery(since=NOW)
    ended = [info(GoalStatus.ABORTED, stamp) for stamp in range(NOW - 1, NOW + 4)]

    def found(page: PastPage) -> list[int]:
        return [one.stamp - NOW for one in ended if page.has(one)]

    assert found(PastPage(wanted)) == [0, 1, 2, 3]
    assert not PastPage().has(info(GoalStatus.EXECUTING))
    place = NOW + 2, b"\x01" * 16
    assert found(PastPage(wanted, after=place)) == [0, 1]
    assert found(PastPage(wanted, after=place, newest_first=False)) == [3]
    assert found(PastPage(wanted, after=(NOW + 2, b"\x02" * 16))) == [0, 1, 2]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("10s", 10), ("10m", 600), ("10min", 600), ("1.5h", 5400), ("7d", 604_800), ("0s", 0)],
)
def test_a_number_with_a_unit_is_a_time_ago(text: str, seconds: int) -> None:
    assert time_of(text, NOW, is_local=False) == NOW - seconds * 10**9


@pytest.mark.parametrize(
    "text",
    [
        "2026-01-31T12:00:00Z",
        "2026-01-31T12:00:00",
        "2026-01-31 13:00+01:00",
        str(NOON),
    ],
)
def test_times_of_iso_8601_and_stamps_are_times(text: str) -> None:
    assert time_of(text, NOW, is_local=False) == NOON


@pytest.fixture
def in_tokyo(monkeypatch: pytest.MonkeyPatch) -> Generator[None, None, None]:
    with monkeypatch.context() as patched:
        patched.setenv("TZ", "JST-9")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("in_tokyo")
def test_a_time_without_a_zone_is_of_this_machine_where_a_person_types_it() -> None:
    assert time_of("2026-01-31T21:00:00", NOW, is_local=True) == NOON
    assert time_of("2026-01-31T12:00:00Z", NOW, is_local=True) == NOON


@pytest.mark.parametrize(
    "text",
    ["", "soon", "10", "20260131", "-10m", "10 m", "10w", "2026-02-30", "9" * 20, "1٢m", "1.m"],
)
def test_other_texts_are_not_times(text: str) -> None:
    with pytest.raises(
        ValueError, match=f"^{re.escape(repr(text))} is not a time: it is as in 202"
    ):
        time_of(text, NOW, is_local=False)


@given(st.text(), st.booleans())
def test_any_text_is_a_time_or_an_error_that_says_what_is(text: str, is_local: bool) -> None:
    try:
        found = time_of(text, NOW, is_local=is_local)
    except ValueError as exc:
        error = str(exc)
    else:
        assert isinstance(found, int)
        return
    assert " is not a time: it is as in 2026-01-31T12:00:00Z" in error


@pytest.mark.usefixtures("in_tokyo")
def test_a_time_that_the_zone_of_this_machine_does_not_reach_is_not_a_time() -> None:
    with pytest.raises(ValueError, match="is not a time"):
        time_of("0001-01-01T00:00:00", NOW, is_local=True)


def test_goals_are_found_by_all_labels_that_are_asked_for() -> None:
    labeled = replace(info(), labels={"order": "17", "site": "north"})
    assert GoalQuery(labels=(("order", "17"),)).has(labeled)
    assert GoalQuery(labels=(("site", "north"), ("order", "17"))).has(labeled)
    assert not GoalQuery(labels=(("order", "17"), ("site", "south"))).has(labeled)
    assert not GoalQuery(labels=(("order", "1"),)).has(labeled)
    assert not GoalQuery(labels=(("note", ""),)).has(labeled)


@pytest.mark.parametrize(
    ("text", "label"),
    [("order=17", ("order", "17")), ("note=", ("note", "")), ("sum=1+1=2", ("sum", "1+1=2"))],
)
def test_a_key_and_a_value_are_a_label(text: str, label: tuple[str, str]) -> None:
    assert label_of(text) == label
    assert re.search(LABEL_TEXT, text)


@pytest.mark.parametrize("text", ["", "order", "=17", "parent=17", "traceparent="])
def test_other_texts_are_not_labels(text: str) -> None:
    with pytest.raises(ValueError, match="is not"):
        label_of(text)
    assert not re.search(LABEL_TEXT, text)


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        *(("1", 1), ("007", 7), (str(NOON), NOON), (str(10**30), 2**63 - 1)),
        *(("10m", NOW - 600 * 10**9), ("2026-01-31T12:00:00Z", NOON)),
        *(("1970-01-01", 1), ("0001-01-01", 1), ("999999999d", 1)),
    ],
)
def test_a_cancel_takes_a_time_or_any_stamp(text: str, stamp: int) -> None:
    assert cancel_stamp_of(text, NOW, is_local=False) == stamp


@pytest.mark.parametrize("text", ["0", "0" * 16, "", "now", "-1"])
def test_a_cancel_up_to_a_time_does_not_mean_all_goals(text: str) -> None:
    with pytest.raises(ValueError, match=r"^a stamp of 0 means all goals|is not a time"):
        cancel_stamp_of(text, NOW, is_local=False)


@pytest.mark.asyncio
@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
async def test_all_pages_are_read_one_after_the_other(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(goal_query, "MOST_PAST", 2)
    ended = GoalStatus.SUCCEEDED
    infos = [info(stamp=stamp, status=ended) for stamp in range(count, 0, -1)]

    async def past_goals(page: PastPage) -> list[GoalInfo]:
        return [one for one in infos if page.has(one)][:2]

    read: list[GoalInfo] = []
    await goal_query.read_pages(past_goals, GoalQuery(), read.extend)
    assert read == infos


@pytest.mark.parametrize(
    ("fields", "error", "text"),
    [
        ({"seconds": 0}, ValueError, "seconds must be more than 0, not 0"),
        ({"seconds": math.nan}, ValueError, "seconds must be more than 0, not nan"),
        ({"seconds": "1"}, TypeError, "seconds must be a number, not '1'"),
        ({"goals": 0}, ValueError, "goals must be 1 or more, not 0"),
        ({"goals": 1.5}, TypeError, "goals must be a whole number, not 1.5"),
    ],
)
def test_bounds_are_checked(fields: dict[str, Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        GoalHistory(**fields)


def test_an_end_is_too_long_ago_after_the_seconds_of_the_history() -> None:
    assert GoalHistory(seconds=2.5).earliest_end(10 * SECOND) == 7.5 * SECOND
    assert GoalHistory(seconds=math.inf).earliest_end(10 * SECOND) == -1


def test_what_is_not_a_history_is_a_type_error() -> None:
    check_is_history(None)
    check_is_history(GoalHistory())
    with pytest.raises(TypeError, match="history must be a GoalHistory, not 5"):
        check_is_history(5)
