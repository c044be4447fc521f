"""The status list, as a server publishes it, and as a client finds changes in it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import anyio
import pytest

from fibaction import GoalID, GoalInfo, GoalStatus
from fibaction._runtime.notify import Notifier
from fibaction.words.statuses import TRANSITIONS
from fibaction_transports.ros2.client.status_lists import ReceivedStatuses
from fibaction_transports.ros2.convert.status_bytes import (
    StatusLine,
    info_of,
    lines_in,
    pack_line,
    pack_statuses,
    unpack_lines,
)
from fibaction_transports.ros2.node.stamps import ServedStamps
from fibaction_transports.ros2.server import served_statuses
from fibaction_transports.ros2.server.served_statuses import (
    LONGEST_PAUSE,
    REPEAT,
    ServedStatuses,
)
from fibaction_transports.ros2.without_ros.own_node import OwnClock
from tests.contract.conftest import anyio_backend  # noqa: F401  # asyncio and trio

pytestmark = pytest.mark.anyio

ONE, TWO = GoalID(b"1" * 16), GoalID(b"2" * 16)


def packed(*goals: GoalInfo) -> bytes:
    return pack_statuses(map(pack_line, goals))


def lines_of(message: bytes) -> list[StatusLine]:
    return unpack_lines(lines_in(message))


# What a server publishes


class Published(list[list[GoalStatus]]):
    def __call__(self, message: bytes) -> None:
        self.append([info_of(line).status for line in lines_of(message)])


async def test_changes_are_published_together_but_no_status_of_a_goal_is_left_out() -> None:
    published = Published()
    statuses = ServedStatuses(published, ServedStamps(OwnClock()))
    statuses.update(GoalInfo(ONE, 1, GoalStatus.ACCEPTED))
    statuses.update(GoalInfo(TWO, 2, GoalStatus.ACCEPTED))
    assert published == []
    statuses.update(GoalInfo(ONE, 1, GoalStatus.EXECUTING))
    assert published == [[1, 1]]
    statuses.flush()
    statuses.flush()
    assert published == [[1, 1], [2, 1]]


async def test_what_is_known_already_or_out_of_date_is_not_published() -> None:
    published = Published()
    statuses = ServedStatuses(published, ServedStamps(OwnClock()))
    statuses.update(GoalInfo(TWO, 2, GoalStatus.UNKNOWN))
    statuses.update(GoalInfo(ONE, 1, GoalStatus.CANCELING))
    for status in (GoalStatus.CANCELING, GoalStatus.EXECUTING):
        statuses.update(GoalInfo(ONE, 1, status))
    statuses.flush()
    assert published == [[3]]


@pytest.mark.promise("STATUS-8")
async def test_a_forgotten_goal_leaves_the_list() -> None:
    published = Published()
    statuses = ServedStatuses(published, ServedStamps(OwnClock()))
    statuses.update(GoalInfo(ONE, 1, GoalStatus.ACCEPTED))
    assert ONE in statuses
    statuses.update(GoalInfo(ONE, 1, GoalStatus.UNKNOWN))
    statuses.flush()
    assert published == [[1], []]
    assert ONE not in statuses
    statuses.clear()
    statuses.update(GoalInfo(ONE, 1, GoalStatus.ACCEPTED))
    statuses.clear()
    statuses.flush()
    assert published == [[1], [], []]


@pytest.mark.anyio
async def test_a_change_is_published_in_the_next_turn_of_the_loop() -> None:
    published = Published()
    statuses = ServedStatuses(published, ServedStamps(OwnClock()))
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(statuses.run)
        for status in (GoalStatus.ACCEPTED, GoalStatus.EXECUTING):
            await anyio.wait_all_tasks_blocked()
            statuses.update(GoalInfo(ONE, 1, status))
        await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()
    assert published == [[1], [2]]


class Clock:
    """The time of status lists, which only the test moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        self._moved = Notifier()
        monkeypatch.setattr(served_statuses, "loop_clock", lambda: lambda: self.now)
        monkeypatch.setattr(anyio, "sleep_until", self._sleep_until)

    async def _sleep_until(self, when: float) -> None:
        while self.now < when:
            await self._moved.wait()

    async def move(self, seconds: float) -> None:
        self.now += seconds
        self._moved.notify()
        await anyio.wait_all_tasks_blocked()


def number_id(number: int) -> GoalID:
    return GoalID(number.to_bytes(16, "big"))


def with_ended_goals(published: Callable[[bytes], None], count: int) -> ServedStatuses:
    """Return a list with so many goals that have ended."""
    statuses = ServedStatuses(published, ServedStamps(OwnClock()))
    for number in range(count):
        statuses.update(GoalInfo(number_id(number), 1, GoalStatus.SUCCEEDED))
    statuses.flush()
    return statuses


ROUND = (GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.SUCCEEDED)


@pytest.mark.parametrize("remembered", [10, 1000])
async def test_the_lists_of_a_series_of_goals_are_bounded_whatever_is_remembered(
    monkeypatch: pytest.MonkeyPatch, remembered: int
) -> None:
    clock = Clock(monkeypatch)
    lists: list[tuple[float, bytes]] = []
    statuses = with_ended_goals(lambda one: lists.append((clock.now, one)), remembered)
    lists.clear()
    ends: dict[GoalID, float] = {}
    kept = [number_id(number) for number in range(remembered)]
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(statuses.run)
        for _ in range(1000):
            goal_id = GoalID.random()
            for status in ROUND:
                statuses.update(GoalInfo(goal_id, 1, status))
            ends[goal_id] = clock.now
            kept.append(goal_id)
            await clock.move(0.001)
            statuses.update(GoalInfo(kept.pop(0), 1, GoalStatus.UNKNOWN))
        for _ in range(21):
            await clock.move(0.001)
        tasks.cancel_scope.cancel()
    assert sum(len(one) for _, one in lists) < 1.5e6
    last = [info_of(line) for line in lines_of(lists[-1][1])]
    assert [(info.goal_id, info.status) for info in last] == [(one, ROUND[-1]) for one in kept]
    for goal_id, ended_at in ends.items():
        told_at = min(when for when, one in lists if bytes(goal_id) in one)
        assert told_at <= ended_at + LONGEST_PAUSE + 0.0011


async def test_a_goal_after_a_pause_has_a_list_for_each_status_whatever_is_remembered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    lists: list[bytes] = []
    statuses = with_ended_goals(lists.append, 1000)
    for goal_id in (ONE, TWO):
        clock.now += 3 * LONGEST_PAUSE
        lists.clear()
        for status in ROUND:
            statuses.update(GoalInfo(goal_id, 1, status))
        statuses.flush()
        assert [info_of(lines_of(one)[-1]).status for one in lists] == list(ROUND)


async def test_a_goal_that_is_forgotten_at_once_leaves_the_list_after_its_end_was_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    lists: list[bytes] = []
    statuses = with_ended_goals(lists.append, 1000)
    for status in (*ROUND, GoalStatus.UNKNOWN):
        statuses.update(GoalInfo(ONE, 1, status))
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(statuses.run)
        for _ in range(3):
            await clock.move(LONGEST_PAUSE)
        tasks.cancel_scope.cancel()
    said = [
        [info.status for info in map(info_of, lines_of(one)) if info.goal_id == ONE]
        for one in lists
    ]
    assert said == [[], [1], [2], [4], []]
    assert ONE not in statuses


# Changes that a client finds


def test_the_first_list_is_what_there_is_and_later_ones_are_changes() -> None:
    known = ReceivedStatuses()
    first = GoalInfo(ONE, 1, GoalStatus.CANCELING)
    assert known.update(packed(first)) == [first]
    assert known.update(packed(first)) == []
    second = GoalInfo(TWO, 2, GoalStatus.SUCCEEDED)
    assert [info.status for info in known.update(packed(first, second))] == [1, 2, 4]
    assert known.get(TWO) == second
    assert known.update(packed(second)) == [GoalInfo(ONE, 1, GoalStatus.UNKNOWN)]
    assert list(known) == [second]
    known.clear()
    assert known.get(TWO) is None
    assert known.update(packed(second)) == [second]


def test_a_goal_that_a_list_has_twice_leaves_the_list_once() -> None:
    known = ReceivedStatuses()
    early, late = GoalInfo(ONE, 1, GoalStatus.ACCEPTED), GoalInfo(ONE, 1, GoalStatus.SUCCEEDED)
    known.update(packed(early, late))
    assert known.update(packed(late)) == [GoalInfo(ONE, 1, GoalStatus.UNKNOWN)]
    assert known.update(packed()) == []
    assert known.update(packed(early)) == [early]


def test_a_line_that_is_wrong_leaves_its_goal_as_it_was(caplog: pytest.LogCaptureFixture) -> None:
    known = ReceivedStatuses()
    first, second = GoalInfo(ONE, 1, GoalStatus.ACCEPTED), GoalInfo(TWO, 2, GoalStatus.ACCEPTED)
    known.update(packed(first))
    wrong = pack_line(first)[:-1] + b"\x09"
    for _ in range(2):
        known.update(pack_statuses([wrong, pack_line(second)]))
    assert list(known) == [first, second]
    assert caplog.messages == [
        "a goal is left out: invalid status list: 9 is not a valid GoalStatus"
    ]


@pytest.mark.promise("STATUS-7")
@pytest.mark.parametrize("before", GoalStatus)
@pytest.mark.parametrize("after", GoalStatus)
def test_statuses_that_were_not_seen_are_filled_in_so_that_every_change_is_legal(
    before: GoalStatus, after: GoalStatus
) -> None:
    known = ReceivedStatuses()
    known.update(packed(GoalInfo(ONE, 1, before)))
    way = [before, *(info.status for info in known.update(packed(GoalInfo(ONE, 1, after))))]
    legal = {(start, end) for (start, _), end in TRANSITIONS.items()}
    assert way[-1] is after
    if len(way) > 2 or (before.is_active and after > before):
        assert all(step in legal for step in pairwise(way))


async def repeated(
    monkeypatch: pytest.MonkeyPatch, *turns: list[GoalInfo]
) -> tuple[list[bytes], int]:
    """Update goals, each turn of them while the repetition for the turn before waits. Return the
    lists, and the number of waits.
    """
    lists: list[bytes] = []
    statuses = ServedStatuses(lists.append, ServedStamps(OwnClock()))
    rest = iter(turns)
    waits = 0

    def update() -> None:
        for info in next(rest, []):
            statuses.update(info)
            if info.status is GoalStatus.ACCEPTED:
                statuses.repeat_later(info.goal_id)
        statuses.flush()

    async def sleep(seconds: float) -> None:
        nonlocal waits
        waits += 1
        assert seconds == REPEAT
        update()
        await anyio.lowlevel.checkpoint()

    monkeypatch.setattr(anyio, "sleep", sleep)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(statuses.repeat)
        update()
        await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()
    return lists, waits


async def test_the_list_is_published_again_after_acceptances_and_once_for_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    goals = [GoalInfo(GoalID.random(), number, GoalStatus.ACCEPTED) for number in range(1, 101)]

    lists, waits = await repeated(monkeypatch, goals[:50], goals[50:])

    assert waits == 2
    assert [len(lines_of(one)) for one in lists] == [50, 100, 100, 100]
    assert {info_of(line) for line in lines_of(lists[-1])} == set(goals)


async def test_the_list_is_not_published_again_for_goals_that_have_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, two = (GoalInfo(goal_id, 1, GoalStatus.ACCEPTED) for goal_id in (ONE, TWO))
    over = [GoalInfo(ONE, 1, GoalStatus.SUCCEEDED), GoalInfo(TWO, 1, GoalStatus.UNKNOWN)]

    lists, waits = await repeated(monkeypatch, [one, two], over)

    assert waits == 1
    assert [len(lines_of(one)) for one in lists] == [2, 1]
