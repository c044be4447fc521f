"""The statuses at the client, one call however many follow them, and pages of the history."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from msgspec.structs import replace

from fibaction.border.abc import ForwardingEndpoint, StatusStream
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
    past_fields,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import ConnectionLost, LimitReached, ProtocolError
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from tests.wire.ends import (
    ANY,
    EXECUTING,
    ONCE,
    WINDOW,
    Network,
    asked_again,
    endpoint_of,
    held,
    reached,
    serving,
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


@pytest.mark.parametrize("is_lost", [False, True])
async def test_a_list_that_ends_early_has_what_has_come_unless_the_connection_is_lost(
    is_lost: bool,
) -> None:
    async with reached(settings=ONCE) as (connection, server):
        statuses, call_id = await watched(connection, server, known=2)
        async with Running(statuses.listed) as listing:
            await told(server, change(call_id, 1))
            assert not listing.is_done
            if is_lost:
                server.channel.cut()
                with pytest.raises(ConnectionLost):
                    await listing.answer()
            else:
                await server.say(Finished(call_id))
                assert [info.stamp for info in await listing.answer()] == [1]


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
            stream.known = 9
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


SUCCEEDED, ABORTED = GoalStatus.SUCCEEDED, GoalStatus.ABORTED


def past(stamp: int, status: GoalStatus = SUCCEEDED) -> GoalInfo:
    return GoalInfo(GoalID(bytes([stamp] * 16)), stamp, status)


def changed(
    call_id: int, stamp: int, status: GoalStatus = SUCCEEDED, reason: str = ""
) -> GoalChanged:
    return GoalChanged(call_id, bytes([stamp] * 16), stamp, status, 0, reason=reason)


class Remembering(ForwardingEndpoint):
    """An endpoint with a history, which notes what it is asked for."""

    def __init__(self, *infos: GoalInfo) -> None:
        super().__init__(held())
        self.infos = infos
        self.asked: list[PastPage] = []

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        self.asked.append(page)
        return list(self.infos)


async def test_a_page_comes_as_the_server_has_it() -> None:
    infos = [past(3), past(2, ABORTED), past(1)]
    endpoint = Remembering(*infos)
    async with serving(endpoint) as served:
        client = await served.greet()
        asked = past_fields(PastPage(limit=3))
        assert await client.ask(WatchStatus(1, "fibonacci", 2, asked), Watching) == Watching(1, 3)
        heard = await client.hear_all()
        assert [message.stamp for message in heard] == [3, 2]
        await client.say(Credit(1, 9))
        last, end = await client.hear_all()
        assert (last.stamp, end) == (1, Finished(1))
    assert endpoint.asked == [PastPage(limit=3)]


async def test_a_page_does_not_count_as_a_watch_and_may_be_closed() -> None:
    async with serving(Remembering(past(1))) as served:
        client = await served.greet()
        asked = past_fields(PastPage())
        await client.ask(WatchStatus(0, "fibonacci", ANY, asked), Watching)
        assert len(await client.hear_all()) == 2
        await client.ask(WatchStatus(1, "fibonacci", ANY), Watching)
        await client.ask(WatchStatus(2, "fibonacci", 0, asked), Watching)
        # Of the next list, nothing is held before this one is told.
        await client.say(WatchStatus(3, "fibonacci", ANY, asked))
        assert await client.hear_all() == []
        await client.say(Close(2))
        heard = await client.hear_by_id()
        assert heard[2] == [Finished(2)]
        assert [type(message) for message in heard[3]] == [Watching, GoalChanged, Finished]
        await client.ask(WatchStatus(4, "fibonacci", ANY), Failed)


async def page_of(endpoint: Any, server: Any, page: PastPage, *answers: Any) -> Any:
    """Return what a client makes of these answers, each a function of the ID of the call."""
    async with Running(lambda: endpoint.past_goals(page)) as asking:
        asked = await server.hear(WatchStatus)
        await server.say(*(answer(asked.id) for answer in answers))
        return await asking.answer()


async def test_a_server_that_knows_no_history_is_asked_once_and_its_list_is_closed() -> None:
    page = PastPage(GoalQuery(frozenset([SUCCEEDED])), 4, (9, bytes([9] * 16)))
    async with reached() as (connection, server):
        infos = await page_of(
            *(endpoint_of(connection), server, page),
            lambda call_id: Watching(call_id, 7),
            lambda call_id: changed(call_id, 2),
            lambda call_id: changed(call_id, 3, ABORTED),
            lambda call_id: changed(call_id, 4, GoalStatus.EXECUTING),
            lambda call_id: changed(call_id, 9),
        )
        assert infos == [past(2)]
        assert [type(message) for message in await server.hear_all()] == [Close]


async def test_goals_of_any_order_are_in_that_of_the_page() -> None:
    answers = (
        lambda call_id: Watching(call_id, 3),
        *(lambda call_id, stamp=stamp: changed(call_id, stamp) for stamp in (2, 1, 3)),
        Finished,
    )
    async with reached() as (connection, server):
        endpoint = endpoint_of(connection)
        assert await page_of(endpoint, server, PastPage(), *answers) == [past(3), past(2), past(1)]
        page = PastPage(newest_first=False, after=(1, bytes([1] * 16)))
        assert await page_of(endpoint, server, page, *answers) == [past(2), past(3)]
        assert await server.hear_all() == []


async def test_an_error_is_raised() -> None:
    async with reached() as (connection, server):
        with pytest.raises(LimitReached, match="no more"):
            await page_of(
                *(endpoint_of(connection), server, PastPage()),
                lambda call_id: Failed(call_id, Why.LIMIT, "no more"),
            )
        assert await server.hear_all() == []


@pytest.mark.parametrize(
    "answers",
    [
        (Done,),
        (Finished,),
        (lambda call_id: changed(call_id, 1),),
        (lambda call_id: Watching(call_id, 1), lambda call_id: Watching(call_id, 1)),
    ],
)
async def test_what_does_not_answer_it_ends_the_connection(answers: Any) -> None:
    async with reached() as (connection, server):
        with pytest.raises(ProtocolError):
            await page_of(endpoint_of(connection), server, PastPage(), *answers)


async def test_a_page_is_asked_for_again_on_the_next_connection() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        async with Running(lambda: endpoint_of(connection).past_goals(PastPage())) as asking:
            asked = await server.hear(WatchStatus)
            await server.say(Watching(asked.id, 2), changed(asked.id, 1))
            server, again = await asked_again(network, server, WatchStatus)
            assert again == asked
            await server.say(Watching(asked.id, 1), changed(asked.id, 2), Finished(asked.id))
            assert await asking.answer() == [past(2)]


async def test_those_who_may_not_observe_see_no_history() -> None:
    access = WireSettings(authorize=lambda peer, action, permission: False)
    async with serving(endpoint := Remembering(past(1)), access=access) as served:
        client = await served.greet()
        asked = WatchStatus(1, "fibonacci", ANY, past_fields(PastPage()))
        assert (await client.ask(asked, Failed)).why == Why.FORBIDDEN
    assert endpoint.asked == []


async def test_words_are_asked_for_by_both_ends() -> None:
    page = PastPage(GoalQuery(words=("gripper",)))
    async with serving(endpoint := Remembering(past(2))) as served:
        client = await served.greet()
        asked = WatchStatus(1, "fibonacci", ANY, past_fields(page), None, ["gripper"])
        await client.ask(asked, Watching)
    assert endpoint.asked == [page]
    async with reached() as (connection, server):
        async with Running(lambda: endpoint_of(connection).past_goals(page)) as asking:
            asked = await server.hear(WatchStatus)
            assert asked.words == ["gripper"]
            told = (changed(asked.id, 1), changed(asked.id, 2, reason="no gripper"))
            await server.say(Watching(asked.id, 2), *told, Finished(asked.id))
            assert [info.stamp for info in await asking.answer()] == [2]


async def test_labels_are_asked_for_and_told() -> None:
    page = PastPage(GoalQuery(labels=(("order", "17"),)))
    labeled = replace(past(2), labels={"order": "17"})
    endpoint = Remembering(labeled)
    async with serving(endpoint) as served:
        client = await served.greet()
        asked = WatchStatus(1, "fibonacci", ANY, past_fields(page), [("order", "17")])
        await client.ask(asked, Watching)
        told, _ = await client.hear_all()
    assert told.labels == {"order": "17"}
    assert endpoint.asked == [page]
