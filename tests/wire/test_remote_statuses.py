"""The statuses at the client: one call for each action, however many follow it."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from fibaction.border.abc import StatusStream
from fibaction.types.action import ActionInfo
from fibaction.wire.client import remote_statuses
from fibaction.wire.frames import MAX_FRAME
from fibaction.wire.messages import (
    AskPlaces,
    AwaitServer,
    Close,
    Credit,
    Done,
    Failed,
    Finished,
    GoalChanged,
    Places,
    Watching,
    WatchStatus,
    Why,
)
from fibaction.words.errors import LimitReached
from fibaction.words.statuses import GoalStatus
from tests.wire.ends import (
    EXECUTING,
    WINDOW,
    endpoint_of,
    reached,
    watched,
)
from tests.wire.memory import Peer, Running, settled

pytestmark = pytest.mark.anyio

ACCEPTED, UNKNOWN = GoalStatus.ACCEPTED, GoalStatus.UNKNOWN
OTHER = ActionInfo("other")


def change(
    call_id: int, stamp: int, status: GoalStatus = EXECUTING, dropped: int = 0
) -> GoalChanged:
    return GoalChanged(call_id, bytes([stamp] * 16), stamp, status, dropped)


async def numbers(statuses: StatusStream, count: int) -> list[int]:
    with anyio.fail_after(5):
        return [info.goal_id[0] async for info in _next(statuses, count)]


async def _next(statuses: StatusStream, count: int) -> Any:
    for _ in range(count):
        info = await statuses.receive()
        assert info is not None
        yield info


async def follow(connection: Any, server: Peer) -> Any:
    """Follow the statuses that another follower in this process follows already."""
    async with Running(endpoint_of(connection).status) as asking:
        (asked,) = await heard(server)
        assert isinstance(asked, AwaitServer)
        await server.say(Done(asked.id))
        return await asking.answer()


async def heard(server: Peer) -> list[Any]:
    return [message for message in await server.hear_all() if not isinstance(message, Credit)]


async def told(server: Peer, *messages: Any) -> None:
    await server.say(*messages)
    await settled()


async def test_followers_that_come_at_once_wait_for_one_answer() -> None:
    async with reached() as (connection, server):
        async with (
            Running(endpoint_of(connection).status) as one,
            Running(endpoint_of(connection).status) as other,
        ):
            asked = await server.hear(WatchStatus)
            assert await server.hear_all() == []
            await told(server, Watching(asked.id, 2), change(asked.id, 1))
            streams = [await one.answer(), await other.answer()]
        assert [stream.known for stream in streams] == [2, 2]
        assert [await numbers(stream, 1) for stream in streams] == [[1], [1]]


async def test_the_last_follower_closes_the_call_and_the_next_opens_another() -> None:
    async with reached() as (connection, server):
        first, call_id = await watched(connection, server)
        second = await follow(connection, server)
        first.close()
        first.close()
        assert await heard(server) == []
        second.close()
        assert await heard(server) == [Close(call_id)]
        # Its end has not come yet, and what comes late is not for the next.
        third, another = await watched(connection, server)
        assert another != call_id
        await told(server, change(call_id, 1), Finished(call_id), change(another, 2))
        assert await numbers(third, 1) == [2]
        assert await second.receive() is None


async def test_a_follower_that_gives_up_before_the_answer_leaves_the_call_to_the_others() -> None:
    async with reached() as (connection, server):
        async with Running(endpoint_of(connection).status) as other:
            asked = await server.hear(WatchStatus)
            async with Running(endpoint_of(connection).status):
                pass
            assert await server.hear_all() == []
            await server.say(Watching(asked.id, 0))
            await other.answer()
        async with Running(lambda: connection.endpoint(OTHER).status()):
            asked = await server.hear(WatchStatus)
        assert await server.hear_all() == [Close(asked.id)]


async def test_an_error_and_an_end_are_for_all_followers() -> None:
    async with reached() as (connection, server):
        streams, call_id = [(first := await watched(connection, server))[0]], first[1]
        streams.append(await follow(connection, server))
        await told(server, change(call_id, 1), Failed(call_id, Why.LIMIT, "no more"))
        for stream in streams:
            assert await numbers(stream, 1) == [1]
            for read in (stream.receive, stream.listed):
                stream.known = 9
                with pytest.raises(LimitReached, match="no more"):
                    await read()
        streams, call_id = [(first := await watched(connection, server))[0]], first[1]
        streams.append(await follow(connection, server))
        await told(server, change(call_id, 1), Finished(call_id))
        for stream in streams:
            assert await numbers(stream, 1) == [1]
            assert await stream.receive() is None
            assert await stream.listed() == []
        await watched(connection, server)


async def test_a_follower_has_what_the_server_has_told_before_its_sign() -> None:
    async with reached() as (connection, server):
        first, call_id = await watched(connection, server, known=0)
        async with Running(endpoint_of(connection).status) as asking:
            (asked,) = await heard(server)
            await told(server, change(call_id, 1), Done(asked.id))
            second = await asking.answer()
        assert [info.stamp for info in await second.listed()] == [1]
        # It may take another call, if this one ends meanwhile.
        async with Running(endpoint_of(connection).status) as asking:
            (asked,) = await heard(server)
            first.close()
            second.close()
            await server.say(Done(asked.id))
            closing, opening = await heard(server)
            assert closing == Close(call_id)
            await server.say(Watching(opening.id, 0))
            assert (await asking.answer()).known == 0


async def test_a_list_that_may_be_incomplete_is_asked_for_again() -> None:
    """The server has left changes out, for example that it has forgotten a goal."""
    async with reached() as (connection, server):
        first, call_id = await watched(connection, server, known=2)
        await told(server, change(call_id, 1), change(call_id, 2), change(call_id, 3, dropped=4))
        async with Running(endpoint_of(connection).status) as asking:
            closing, asked = await heard(server)
            assert (closing, asked) == (Close(call_id), WatchStatus(asked.id, "fibonacci", WINDOW))
            await told(server, Finished(call_id), Watching(asked.id, 1), change(asked.id, 3))
            second = await asking.answer()
        assert [info.stamp for info in await second.listed()] == [3]
        assert await numbers(first, 4) == [1, 2, 3, 3]  # it hears the list once more
        await told(server, change(asked.id, 5, dropped=2))
        assert (first.dropped, second.dropped) == (6, 2)


def accepted(call_id: int, stamp: int, place: int = 0, length: int = 0) -> GoalChanged:
    """A goal that has not begun, as it was at some time."""
    goal_id = bytes([stamp] * 16)
    return GoalChanged(call_id, goal_id, stamp, ACCEPTED, 0, 0, "", place, length)


async def places_for(connection: Any, server: Peer, *waiting: Any) -> list[tuple[int, int, int]]:
    """Follow the statuses anew; the server says that these goals wait."""
    async with Running(endpoint_of(connection).status) as asking:
        (asked,) = await heard(server)
        assert asked == AskPlaces(asked.id, "fibonacci", MAX_FRAME // 64)
        await server.say(Places(asked.id, list(waiting)))
        statuses = await asking.answer()
    listed = [(info.stamp, info.place, info.queue_length) for info in await statuses.listed()]
    statuses.close()
    return listed


async def test_a_follower_that_comes_later_is_told_the_places_of_goals_that_wait_now() -> None:
    """No change tells them: at each start of a goal all others move up."""
    async with reached() as (connection, server):
        first, call_id = await watched(connection, server, known=4)
        await told(
            server, change(call_id, 1), accepted(call_id, 2, 1, 3), accepted(call_id, 3, 2, 3)
        )
        await told(server, accepted(call_id, 4, 3, 3))
        listed = [(info.stamp, info.place, info.queue_length) for info in await first.listed()]
        assert listed == [(1, 0, 0), (2, 1, 3), (3, 2, 3), (4, 3, 3)]
        now = [(bytes([number] * 16), place, 2) for number, place in ((1, 9), (3, 1), (4, 2))]
        # The first goal has begun, whatever is told of it; the second is about to begin.
        assert await places_for(connection, server, *now) == [
            *((1, 0, 0), (2, 0, 0), (3, 1, 2), (4, 2, 2))
        ]
        # A server that tells no places, for example over ROS, has no goals that wait.
        assert await places_for(connection, server) == [
            *((1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0))
        ]
        await told(server, *(change(call_id, stamp) for stamp in (2, 3, 4)))
        assert (await follow(connection, server)).known == 4


async def test_places_are_asked_for_if_a_goal_comes_to_wait_before_the_sign() -> None:
    async with reached() as (connection, server):
        _, call_id = await watched(connection, server, known=0)
        async with Running(endpoint_of(connection).status) as asking:
            (asked,) = await heard(server)
            await told(server, accepted(call_id, 2), Done(asked.id))
            (asked,) = await heard(server)
            assert asked == AskPlaces(asked.id, "fibonacci", MAX_FRAME // 64)
            await server.say(Places(asked.id, [(bytes([2] * 16), 1, 3)]))
            statuses = await asking.answer()
        listed = await statuses.listed()
        assert [(info.stamp, info.place, info.queue_length) for info in listed] == [(2, 1, 3)]


async def test_a_slow_follower_loses_the_oldest_changes_and_delays_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(remote_statuses, "UNREAD", 3)
    async with reached() as (connection, server):
        slow, call_id = await watched(connection, server, known=1)
        fast = await follow(connection, server)
        for stamp in range(1, 8):
            await told(server, change(call_id, stamp))
            assert await numbers(fast, 1) == [stamp]
        assert (slow.dropped, fast.dropped) == (3, 0)
        assert await slow.listed() == []
        assert await numbers(slow, 4) == [4, 5, 6, 7]


async def test_a_server_cannot_make_its_client_remember_ever_more_goals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(remote_statuses, "MOST_GOALS", 3)
    async with reached() as (connection, server):
        _, call_id = await watched(connection, server, known=2**62)
        await told(server, *(change(call_id, stamp) for stamp in range(1, 8)))
        late = await follow(connection, server)
        assert await numbers(late, 3) == [5, 6, 7]
