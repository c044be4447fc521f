"""Pages of the history of a server over the wire, at both ends."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from fibaction.border.abc import ForwardingEndpoint
from fibaction.wire.messages import (
    Close,
    Credit,
    Done,
    Failed,
    Finished,
    GoalChanged,
    Watching,
    WatchStatus,
    Why,
    past_fields,
)
from fibaction.wire.settings import WireSettings
from fibaction.words.errors import LimitReached, ProtocolError
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from tests.wire.ends import ANY, Network, asked_again, endpoint_of, held, reached, serving
from tests.wire.memory import Running

pytestmark = pytest.mark.anyio

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
