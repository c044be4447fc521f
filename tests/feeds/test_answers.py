"""`fibaction.feeds.answers`: a silent server is not waited for, and each goal is found once."""

from __future__ import annotations

import random
from typing import Any

import anyio
import pytest

from fibaction import ActionServer, GoalID, GoalInfo, GoalStatus, ServerNotFound, TransportError
from fibaction.border.abc import Absence, ForwardingEndpoint
from fibaction.feeds import answers
from fibaction.feeds.answers import ANSWERING, GoalSearch, intakes_of, statuses_soon
from fibaction.feeds.status_broadcast import StatusBroadcast
from fibaction.types.action import ActionInfo
from fibaction.words.goal_query import GoalQuery, words_of
from fibaction.words.goals import Parent
from fibaction.words.intake import Intake, IntakeChange, IntakeMode
from tests.support.fibonacci import FIBONACCI, fibonacci
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio


class Silent(ForwardingEndpoint):
    async def intake(self) -> Intake:
        await anyio.sleep_forever()
        raise AssertionError


class Away(ForwardingEndpoint):
    @property
    def absence(self) -> Absence | None:
        return Absence(0, "gone")


class Forbidden(ForwardingEndpoint):
    async def intake(self) -> Intake:
        raise TransportError("no")


async def test_each_action_tells_how_it_takes_goals_and_nobody_waits_for_one_that_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers, "INTAKES_TIMEOUT", 0.2)
    async with ActionServer(FIBONACCI, fibonacci) as server:
        assert (await intakes_of([server]))["fibonacci"].mode is IntakeMode.OPEN
        paused = await server.change_intake(IntakeChange(IntakeMode.HOLD))
        assert await intakes_of([Silent(server), Forbidden(server)]) == {}
        assert await intakes_of([Silent(server), server]) == {"fibonacci": paused}
        assert await intakes_of([Away(server)]) == {}
        wrapped = ForwardingEndpoint(server)
        assert await wrapped.change_intake(IntakeChange(IntakeMode.OPEN)) == await wrapped.intake()


class Slow:
    """An endpoint that answers after some seconds."""

    info = ActionInfo("pick")

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    async def status(self) -> str:
        await anyio.sleep(self._seconds)
        return "statuses"


@in_virtual_time()
async def test_a_server_that_answers_late_is_waited_for_and_one_that_is_frozen_is_not() -> None:
    late: Any = Slow(0.9 * ANSWERING)
    assert str(await statuses_soon(late)) == "statuses"
    frozen: Any = Slow(100)
    began = anyio.current_time()
    with pytest.raises(ServerNotFound, match="'pick' has not answered for 5 s: ask again"):
        await statuses_soon(frozen)
    assert anyio.current_time() - began == pytest.approx(ANSWERING)


WALK = random.Random(3).sample(range(1, 101), 100)
"""The numbers of goals in the order of their ends."""


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
    monkeypatch.setattr(answers, "HELD", 3)
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
