"""`fibaction.feeds.goal_search`: goals of a server and of its history, each once."""

from __future__ import annotations

import random
from typing import Any

import pytest

from fibaction import GoalID, GoalInfo, GoalStatus
from fibaction.feeds import goal_search
from fibaction.feeds.goal_search import GoalSearch
from fibaction.feeds.status_broadcast import StatusBroadcast
from fibaction.types.action import ActionInfo
from fibaction.words.goal_query import GoalQuery, words_of
from fibaction.words.goals import Parent

WALK = random.Random(3).sample(range(1, 101), 100)
"""The numbers of goals in the order of their ends."""

pytestmark = pytest.mark.anyio


def goal(stamp: int, **facts: Any) -> GoalInfo:
    told = {"status": GoalStatus.SUCCEEDED, **facts}
    return GoalInfo(GoalID(stamp.to_bytes(16, "big")), stamp, **told)


class Endpoint:
    """An endpoint that remembers some goals, and gives those of its history in pages."""

    info = ActionInfo("arm/pick")

    def __init__(self, known: list[GoalInfo], past: list[GoalInfo]) -> None:
        self.known = known
        self.past = past
        self.asked: list[GoalQuery] = []

    async def status(self) -> Any:
        class Listed:
            changed = 0

            def __init__(self, info: GoalInfo) -> None:
                self.goal_id, self.info = info.goal_id, info

        return StatusBroadcast().follow([Listed(info) for info in self.known])

    async def read_past(self, wanted: GoalQuery, take: Any) -> None:
        self.asked.append(wanted)
        for info in self.past:
            take([info] if wanted.has(info) else [])


def search(text: str = "", limit: int = 100, sort: str = "accepted", **more: Any) -> GoalSearch:
    options = {"descending": True, "offset": 0, **more}
    return GoalSearch(GoalQuery(words=words_of(text)), sort, limit=limit, **options)


async def found(endpoint: Any, wanted: GoalSearch) -> list[GoalInfo]:
    await wanted.ask(endpoint)
    return [one.info for one in await wanted.page()]


async def test_a_goal_that_is_remembered_is_found_once_as_the_server_knows_it() -> None:
    known = [goal(3, reason="late"), goal(4, status=GoalStatus.EXECUTING)]
    endpoint = Endpoint(known, [goal(1), goal(2), goal(3)])
    assert await found(endpoint, search()) == [known[1], known[0], goal(2), goal(1)]
    assert await found(endpoint, search("pick late")) == [known[0]]
    assert endpoint.asked[-1].words == ("late",)  # read where the history is


async def test_of_many_goals_all_are_counted_and_few_are_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_search, "HELD", 3)
    newest = search(limit=2, offset=1)
    stamps = [info.stamp for info in await found(Endpoint([], [goal(n) for n in WALK]), newest)]
    assert (stamps, newest.total) == ([99, 98], 100)
    assert len(newest._found) < 20  # no way to see it from outside


async def test_a_page_is_in_the_order_that_is_asked_for() -> None:
    goals = [goal(stamp, client=f"c{stamp % 2}") for stamp in range(6)]

    async def stamps(*, descending: bool) -> list[int]:
        page = search(limit=3, sort="client", offset=1, descending=descending)
        return [info.stamp for info in await found(Endpoint([], goals), page)]

    assert await stamps(descending=False) == [2, 4, 1]
    assert await stamps(descending=True) == [3, 1, 4]


async def test_children_are_found_by_their_parent_and_not_by_a_text_that_names_it() -> None:
    mission = goal(1)
    child = goal(2, parent=Parent(mission.goal_id, "weld"))
    other = goal(3, reason=f"as {mission.goal_id}")
    endpoint = Endpoint([mission], [child, other])
    assert await found(endpoint, search(parent=mission.goal_id)) == [child]


async def test_a_server_that_does_not_know_the_words_of_a_search_adds_no_others() -> None:
    class Older(Endpoint):
        async def read_past(self, wanted: GoalQuery, take: Any) -> None:
            take(self.past)

    late = goal(1, reason="late")
    wanted = search("late")
    assert (await found(Older([], [late, goal(2)]), wanted), wanted.total) == ([late], 1)
