from __future__ import annotations

import gc
import tracemalloc
import weakref

import anyio
import pytest
from hypothesis import given, strategies

from fibaction.border.abc import StatusStream
from fibaction.feeds.status_broadcast import StatusBroadcast, StatusCursor, StatusSubscription
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.words.errors import ConnectionLost
from fibaction.words.goals import UNKNOWN_SENDER, GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus

GOAL_ID = GoalID(bytes(range(16)))


def info(number: int, status: GoalStatus = GoalStatus.ACCEPTED) -> GoalInfo:
    return GoalInfo(GOAL_ID, number, status)


async def stamps(stream: StatusStream) -> list[int]:
    """The stamps of all changes up to the end of the stream."""
    seen: list[int] = []
    while (change := await stream.receive()) is not None:
        seen.append(change.stamp)
    return seen


class Goals:
    """Goals whose statuses are broadcast, as a server has them."""

    def __init__(self, *, known: int = 0, limit: int = 10_000) -> None:
        self.feed = StatusBroadcast(limit)
        self.records = [self._new(number) for number in range(1, known + 1)]

    @staticmethod
    def _new(number: int) -> GoalRecord:
        return GoalRecord(GoalID(number.to_bytes(16, "big")), b"", number, UNKNOWN_SENDER)

    def follow(self) -> StatusCursor:
        return self.feed.follow(tuple(self.records))

    def change(self, number: int, status: GoalStatus = GoalStatus.EXECUTING) -> None:
        record = self.records[number - 1]
        record.status = record.told_status = status
        record.changed = self.feed.publish(record.info)


ORDER = [GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.CANCELING, GoalStatus.CANCELED]


@given(
    steps=strategies.lists(
        strategies.sampled_from(["read", "follow"]) | strategies.integers(1, 4), max_size=60
    ),
    limit=strategies.sampled_from([3, 1000]),
)
def test_every_follower_is_told_every_goal_forwards_and_up_to_its_newest_status(
    steps: list[int | str], limit: int
) -> None:
    async def check() -> None:
        goals = Goals(known=4, limit=limit)
        readers: list[tuple[StatusCursor, list[GoalInfo]]] = []
        for step in steps:
            if step == "follow":
                readers.append((goals.follow(), []))
            elif isinstance(step, int):
                later = ORDER.index(goals.records[step - 1].status) + 1
                if later < len(ORDER):
                    goals.change(step, ORDER[later])
            else:
                for stream, seen in readers:
                    with anyio.move_on_after(0):
                        if (info := await stream.receive()) is not None:
                            seen.append(info)
        goals.feed.finish()
        for stream, seen in readers:
            while (info := await stream.receive()) is not None:
                seen.append(info)
            assert [info.goal_id for info in seen[:4]] == [goal.goal_id for goal in goals.records]
            for goal in goals.records:
                statuses = [
                    ORDER.index(info.status) for info in seen if info.goal_id == goal.goal_id
                ]
                assert statuses == sorted(set(statuses))
                if not stream.dropped:
                    assert statuses[-1] == ORDER.index(goal.status)
                    assert statuses == list(range(statuses[0], statuses[-1] + 1))

    anyio.run(check)


def test_a_follower_that_does_not_read_costs_nothing_for_each_goal_and_change() -> None:
    goals = Goals(known=1)
    records = tuple(goals.records * 10_000)
    gc.collect()
    tracemalloc.start()
    try:
        streams = [goals.feed.follow(records) for _ in range(100)]
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(1000):
            goals.change(1)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert before < 100 * 2000
    assert after - before < 300_000, "the changes are remembered once for all"
    assert streams[0].known == 10_000


@pytest.mark.asyncio
async def test_a_list_that_was_read_keeps_no_goal_alive() -> None:
    class Watched(GoalRecord):
        """Unlike a plain record it can be watched."""

        __slots__ = ("__weakref__",)

    record = Watched(GOAL_ID, b"", 1, UNKNOWN_SENDER)
    stream = StatusBroadcast().follow((record,))
    watched = weakref.ref(record)
    del record
    assert watched() is not None
    with anyio.fail_after(5):
        await stream.receive()
    assert watched() is None


@pytest.mark.asyncio
async def test_a_status_stream_that_is_not_read_loses_the_oldest_changes() -> None:
    goals = Goals(known=2, limit=2)
    stream = goals.follow()
    for number in range(3, 8):
        goals.feed.publish(info(number))
    assert stream.dropped == 3
    goals.feed.finish()
    with anyio.fail_after(5):
        # The limit is for changes: what was known at the beginning is not lost.
        assert await stamps(stream) == [1, 2, 6, 7]
    assert stream.dropped == 3


@pytest.mark.asyncio
@pytest.mark.parametrize("others", [0, 1])
async def test_a_closed_status_stream_gives_what_was_there_before(others: int) -> None:
    feed = StatusBroadcast(limit=2)
    stream = feed.follow(())
    for _ in range(others):
        feed.follow(())
    for number in range(3):
        feed.publish(info(number))
    stream.close()
    for number in range(3, 3 + others):
        feed.publish(info(number))
    with anyio.fail_after(5):
        assert await stamps(stream) == ([2] if others else [1, 2])
    assert stream.dropped == (2 if others else 1)


@pytest.mark.asyncio
async def test_a_feed_that_no_one_follows_forgets_its_changes() -> None:
    feed = StatusBroadcast()
    feed.follow(()).close()
    feed.publish(info(1))
    one = feed.follow(())
    assert feed.publish(info(2)) == 2
    one.close()
    assert not feed._changes.items
    with anyio.fail_after(5):
        assert await stamps(one) == [2]
    other = feed.follow(())
    assert feed.publish(info(3)) == 3
    feed.finish()
    with anyio.fail_after(5):
        assert await stamps(other) == [3]


@pytest.mark.asyncio
async def test_a_server_s_status_stream_that_has_failed_gives_what_is_left_and_then_the_error() -> (
    None
):
    goals = Goals(known=1)
    stream, closed, ended = goals.follow(), goals.follow(), goals.follow()
    goals.feed.publish(info(7))
    error = ConnectionLost("the connection was closed here")
    for one in (stream, closed):
        one.fail(error)
    closed.close()
    goals.feed.publish(info(8))
    goals.feed.finish()
    ended.fail(error)
    raised = [error]
    with anyio.fail_after(5):
        assert [await stream.receive(), await stream.receive()] == [
            goals.records[0].info,
            info(7),
        ]
        for _ in range(2):
            with pytest.raises(ConnectionLost, match=r"^the connection was closed here$") as caught:
                await stream.receive()
            raised.append(caught.value)
        assert await stamps(closed) == [1, 7]
        assert await stamps(ended) == [1, 7, 8], "it had ended before"
    assert len(set(map(id, raised))) == 3


def new_stream(*stamps: int, limit: int = 1000) -> StatusSubscription:
    """A stream of statuses that is not of a feed; goals with those stamps are known."""
    return StatusSubscription([info(stamp) for stamp in stamps], lambda _: None, limit)


@pytest.mark.asyncio
async def test_a_status_stream_that_has_failed_gives_what_is_left_and_then_the_error() -> None:
    stream = new_stream(1)
    stream.put(info(2))
    stream.fail(ConnectionLost("the server has gone away"))
    with anyio.fail_after(5):
        assert [await stream.receive(), await stream.receive()] == [info(1), info(2)]
        for _ in range(2):
            with pytest.raises(ConnectionLost, match=r"^the server has gone away$"):
                await stream.receive()


@pytest.mark.asyncio
async def test_what_is_known_has_room_beside_the_limit_and_what_gives_way_is_counted() -> None:
    stream = new_stream(1, 2, limit=3)
    for number in range(3, 6):
        stream.put(info(number))
    assert (stream.known, stream.dropped) == (2, 0)
    stream.put(info(6))
    stream.put(info(7))
    assert (stream.known, stream.dropped) == (2, 2)
    stream.close()
    with anyio.fail_after(5):
        assert await stamps(stream) == [3, 4, 5, 6, 7]
    assert (stream.known, stream.dropped) == (2, 2)


@pytest.mark.asyncio
async def test_a_feed_tells_whether_it_is_followed() -> None:
    feed = StatusBroadcast()
    assert not feed.is_followed
    one, other = feed.follow(()), feed.follow(())
    one.close()
    assert feed.is_followed
    other.close()
    assert not feed.is_followed
