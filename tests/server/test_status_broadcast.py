from __future__ import annotations

from collections.abc import Awaitable, Callable

import anyio
import pytest

from fibaction.exceptions import ConnectionLost
from fibaction.goals import GoalID, GoalInfo
from fibaction.server.status_broadcast import StatusBroadcast, StatusSubscription
from fibaction.states import GoalStatus

GOAL_ID = GoalID(bytes(range(16)))


def info(number: int, status: GoalStatus = GoalStatus.ACCEPTED) -> GoalInfo:
    return GoalInfo(GOAL_ID, number, status)


async def stamps(stream: StatusSubscription) -> list[int]:
    """The stamps of all changes up to the end of the stream."""
    seen: list[int] = []
    while (change := await stream.receive()) is not None:
        seen.append(change.stamp)
    return seen


async def while_waiting(waiting: Callable[[], Awaitable[object]], then: Callable[[], None]) -> None:
    """See that something waits, do something about it, and see that it waits no longer."""
    done = anyio.Event()

    async def wait() -> None:
        await waiting()
        done.set()

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(wait)
            await anyio.wait_all_tasks_blocked()
            assert not done.is_set()
            then()


@pytest.mark.asyncio
async def test_a_status_stream_begins_with_what_is_known_and_goes_on_with_each_change() -> None:
    feed = StatusBroadcast()
    feed.publish(info(0))
    stream = feed.follow([info(1), info(2)])
    feed.publish(info(3, GoalStatus.UNKNOWN))
    feed.finish()
    with anyio.fail_after(5):
        assert await stream.receive() == info(1)
        assert await stamps(stream) == [2, 3]
        assert await stream.receive() is None
    assert stream.dropped == 0


@pytest.mark.asyncio
async def test_a_status_stream_says_how_much_of_it_was_known_when_it_began() -> None:
    feed = StatusBroadcast()
    one, other = feed.follow([info(1), info(2)]), feed.follow([])
    feed.publish(info(3))
    with anyio.fail_after(5):
        await one.receive()
    assert (one.known, other.known) == (2, 0)


@pytest.mark.asyncio
@pytest.mark.parametrize(
    "happens",
    [lambda feed: feed.publish(info(1)), StatusBroadcast.finish],
    ids=["a change", "the end"],
)
async def test_a_status_stream_waits_for_a_change_or_the_end(
    happens: Callable[[StatusBroadcast], None],
) -> None:
    feed = StatusBroadcast()
    stream = feed.follow([])
    await while_waiting(stream.receive, lambda: happens(feed))


@pytest.mark.asyncio
async def test_closing_a_status_stream_ends_the_wait() -> None:
    stream = StatusBroadcast().follow([])
    await while_waiting(stream.receive, stream.close)


@pytest.mark.asyncio
async def test_a_status_stream_that_is_not_read_loses_the_oldest_changes() -> None:
    feed = StatusBroadcast(limit=2)
    stream = feed.follow([info(1), info(2)])
    for number in range(3, 8):
        feed.publish(info(number))
    feed.finish()
    with anyio.fail_after(5):
        # The limit is for changes: what was known at the beginning has room besides.
        assert await stamps(stream) == [4, 5, 6, 7]
    assert stream.dropped == 3


def test_ten_thousand_changes_are_kept_for_a_status_stream_unless_told() -> None:
    feed = StatusBroadcast()
    stream = feed.follow([])
    for number in range(10_000):
        feed.publish(info(number))
    assert stream.dropped == 0
    feed.publish(info(10_000))
    assert stream.dropped == 1


@pytest.mark.asyncio
async def test_each_status_stream_sees_all_changes_and_one_that_is_closed_none() -> None:
    feed = StatusBroadcast()
    one, other, closed = (feed.follow([]) for _ in range(3))
    closed.close()
    closed.close()
    feed.publish(info(1))
    feed.finish()
    with anyio.fail_after(5):
        assert await stamps(one) == await stamps(other) == [1]
        assert await stamps(closed) == []


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
async def test_a_wait_for_a_status_is_told_that_the_stream_has_failed() -> None:
    stream = new_stream()

    async def lost() -> None:
        with pytest.raises(ConnectionLost, match="gone away"):
            await stream.receive()

    await while_waiting(lost, lambda: stream.fail(ConnectionLost("the server has gone away")))


@pytest.mark.asyncio
async def test_each_reader_of_a_failed_status_stream_gets_an_error_of_its_own() -> None:
    stream = new_stream()
    error = ConnectionLost("the server has gone away")
    stream.fail(error)
    caught: list[ConnectionLost] = [error]
    for _ in range(2):
        with pytest.raises(ConnectionLost) as raised:
            await stream.receive()
        caught.append(raised.value)
    # A traceback grows with each `raise` of the same error.
    assert len(set(map(id, caught))) == 3


@pytest.mark.asyncio
async def test_a_status_stream_that_was_closed_ends_even_if_it_has_failed() -> None:
    stream = new_stream(1)
    stream.fail(ConnectionLost("the server has gone away"))
    stream.close()
    with anyio.fail_after(5):
        assert await stamps(stream) == [1]


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
async def test_a_feed_is_true_as_long_as_it_is_followed() -> None:
    feed = StatusBroadcast()
    assert not feed
    one, other = feed.follow([]), feed.follow([])
    one.close()
    assert feed
    other.close()
    assert not feed
