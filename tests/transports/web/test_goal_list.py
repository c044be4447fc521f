"""`fibaction_transports.web.rest.goal_list`: pages of goals, turns of lists, and `GET /goals`."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import anyio
import anyio.lowlevel
import pytest
from msgspec.structs import replace

from fibaction import (
    Action,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    Peer,
    Permission,
    SqliteStore,
)
from fibaction.border.abc import ForwardingEndpoint
from fibaction.border.endpoints import Absence
from fibaction.border.http_access import Refused
from fibaction.feeds.status_broadcast import StatusBroadcast
from fibaction.words.errors import ConnectionLost
from fibaction.words.goal_query import PastPage
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rest import goal_list
from fibaction_transports.web.rest.goal_list import Page, listed, page_of, past_of
from tests.transports.web.http_client import fetch, served

pytestmark = pytest.mark.anyio

NOW = 1_800_000_000 * 10**9


class Listed:
    """A goal of a list."""

    changed = 0

    def __init__(self, number: int) -> None:
        self.goal_id = GoalID(number.to_bytes(16, "big"))
        self.info = GoalInfo(self.goal_id, number // 2, GoalStatus.EXECUTING)


def goals(*numbers: int) -> Any:
    """A stream that begins with these goals, of which two each have the same stamp."""
    return StatusBroadcast().follow([Listed(number) for number in numbers])


async def numbers_in(page: Page, *numbers: int) -> tuple[list[int], str]:
    body, cursor = await listed(goals(*numbers), page, anyio.Lock())
    return [int(one["goal_id"], 16) for one in json.loads(body)], cursor


async def test_pages_follow_each_other_without_a_goal_twice_or_left_out() -> None:
    found: list[int] = []
    page = Page(2)
    while True:
        more, cursor = await numbers_in(page, 7, 2, 5, 3, 1)
        found += more
        if not cursor:
            break
        page = read(f"?limit=2&after={cursor}")
    assert found == [1, 2, 3, 5, 7]


class PastEndpoint:
    """An endpoint with a history: goals of which two each have the same stamp."""

    def __init__(self, *numbers: int) -> None:
        self.infos = [Listed(number).info for number in numbers]
        self.asked = 0

    async def past_goals(self, page: PastPage) -> list[GoalInfo]:
        assert not page.newest_first
        self.asked += 1
        assert page.after is not None
        infos = [one for one in self.infos if (one.stamp, one.goal_id) > page.after]
        return [one for one in infos if page.wanted.has(one)][: page.limit]


async def with_past(page: Page, endpoint: Any, *numbers: int) -> tuple[list[int], str]:
    past = await past_of(endpoint, page)
    body, cursor = await listed(goals(*numbers), page, anyio.Lock(), past)
    return [int(one["goal_id"], 16) for one in json.loads(body)], cursor


async def test_pages_have_the_goals_of_the_history_and_those_that_are_remembered_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(goal_list, "MOST_PAST", 3)
    endpoint = PastEndpoint(1, 2, 3, 5, 6, 7, 8)
    found: list[int] = []
    page = read("?limit=4&past=true")
    while True:
        more, cursor = await with_past(page, endpoint, 4, 5, 9)
        found += more
        if not cursor:
            break
        page = read(f"?limit=4&past=true&after={cursor}")
    assert found == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert (await with_past(read("?past=true"), endpoint, 9))[0] == [1, 2, 3]


def read(query: str) -> Page:
    """The page that a request with this query names."""
    return page_of(parse_qs(query[1:], strict_parsing=bool(query[1:]), keep_blank_values=True), NOW)


@pytest.mark.parametrize(
    "query",
    [
        "?limit=5",
        f"?limit=5&parent={1:032x}",
        "?limit=5&status=active&status=ABORTED",
        "?limit=5&past=true&status=SUCCEEDED",
        "?limit=5&client=robot%207+at+%26+%3Climit%3E",
        "?limit=5&since=10m&until=2026-01-31T12:00:00%2B01:00",
        "?limit=5&label=order=17&label=note=a%20%26%3D",
    ],
)
def test_the_next_page_is_of_the_same_goals(query: str) -> None:
    cursor = f"7.{2:032x}"
    page = read(query)
    next_page = read(page.next_query(cursor))

    assert next_page == page._replace(after=(7, bytes(15) + b"\x02"))
    assert not re.search(r"[\s<>]", page.next_query(cursor))


@pytest.mark.parametrize("time", ["0001-01-01", "1970-01-02T00:00:00Z", "9999-12-31"])
def test_the_next_page_has_times_that_no_stamp_can_tell_too(time: str) -> None:
    page = read(f"?limit=5&since={time}&until={time}")
    wanted = read(page.next_query(f"7.{2:032x}")).wanted
    for stamp in (1, 10**18):
        info = replace(Listed(0).info, stamp=stamp)
        assert wanted.has(info) == page.wanted.has(info)


@pytest.mark.parametrize(
    ("query", "text"),
    [
        ("?status=lost", "status is one of active, ended, ACCEPTED, EXECUTING, CANCELING"),
        ("?status=ABORTED&status=", "status is one of active"),
        ("?status=ABORTED,CANCELED", "each in its own parameter"),
        ("?since=soon", "since: 'soon' is not a time"),
        ("?since=1m&until=", "until: '' is not a time"),
        *((f"?limit={limit}", "between 1 and 10000") for limit in ("0", "-1", "x", "")),
        ("?limit=2&after=7", "a cursor of the header Link"),
        ("?after=1.zz", "a cursor of the header Link"),
        ("?past=1", "past is true or false"),
        ("?parent=me", "^parent is the ID of a goal: a goal ID has 32 hexadecimal"),
        (f"?parent={0:032x}", "zeros means all goals"),
    ],
)
def test_a_query_that_means_nothing_is_refused(query: str, text: str) -> None:
    with pytest.raises(Refused, match=text) as refused:
        read(query)
    assert refused.value.status == 400


async def test_a_stream_that_ends_ends_the_list() -> None:
    stream = goals(1, 2)
    await stream.receive()
    stream.close()
    assert (await listed(stream, Page(), anyio.Lock()))[0].count(b"goal_id") <= 1


def test_a_page_has_a_size_that_the_server_bounds() -> None:
    assert read("?limit=5") == Page(5)
    assert read(f"?limit={'9' * 30}").limit == 10_000


async def test_lists_have_one_slice_of_each_turn_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(goal_list, "SLICE", -1.0)  # each goal is a slice
    turn, done = anyio.Lock(), 0

    async def read() -> None:
        nonlocal done
        await listed(goals(*range(1, 6)), Page(), turn)
        done += 1

    async with anyio.create_task_group() as tasks:
        for _ in range(3):
            tasks.start_soon(read)
        turns = 0
        while done < 3:
            await anyio.lowlevel.checkpoint()
            turns += 1
    assert turns >= 3 * 2 * 5 - 5


PICK = Action("arm/pick", goal=int, feedback=int, result=str)
DRIVE = Action("drive", goal=int, feedback=int, result=str)


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.request == 0:
        raise GoalAborted("the gripper is OPEN")
    yield str(goal.request)


class Unreachable(ForwardingEndpoint):
    """An endpoint whose server does not answer, and one that is known to be away."""

    is_known = True

    @property
    def absence(self) -> Absence | None:
        return Absence(1.0, "no answer") if self.is_known else None

    async def status(self) -> Any:
        raise ConnectionLost("no answer")


@asynccontextmanager
async def robot(path: Path, **settings: Any) -> AsyncGenerator[str, None]:
    """Serve two actions: `arm/pick` forgets each goal at its end, and has a history."""
    store = SqliteStore(path / "goals.db", history=GoalHistory())
    pick = ActionServer(PICK, work, store=store, result_timeout=0)
    async with served(pick, ActionServer(DRIVE, work), **settings) as url:
        for number in range(5):
            label = f"label=order={number}"
            await fetch(url, "POST", f"/actions/arm/pick/goals?wait=20&{label}", number)
        await fetch(url, "POST", "/actions/drive/goals?wait=20", 7)
        yield url


async def search(url: str, query: str = "") -> tuple[int, list[str]]:
    """The number of all goals that a search finds, and the orders of those on its page."""
    answer = await fetch(url, "GET", f"/goals?{query}")
    assert answer.status == 200, answer.json
    orders = [goal.get("labels", {}).get("order", goal["action"]) for goal in answer.json["goals"]]
    return answer.json["total"], orders


async def test_goals_of_all_actions_are_found_with_their_number(tmp_path: Path) -> None:
    async with robot(tmp_path) as url:
        assert await search(url) == (6, ["drive", "4", "3", "2", "1", "0"])
        assert await search(url, "limit=2&offset=1") == (6, ["4", "3"])
        assert await search(url, "sort=accepted&limit=2") == (6, ["0", "1"])
        assert await search(url, "sort=-status&limit=1") == (6, ["0"])
        assert await search(url, "search=PICK%20gripper") == (1, ["0"])
        assert await search(url, "action=arm/pick&search=order%3D3") == (1, ["3"])
        assert await search(url, "label=order=2&status=ended") == (1, ["2"])
        assert await search(url, f"parent={1:032x}") == (0, [])


@pytest.mark.parametrize(
    ("query", "status", "text"),
    [
        ("sort=color", 400, "sort is one of accepted, began"),
        ("offset=-1", 400, "offset is a number of goals"),
        ("after=1", 400, "GET has no parameter 'after' here"),
        ("action=fly", 404, "there is no action 'fly'"),
    ],
)
async def test_a_search_that_is_wrong_says_what_is_right(
    tmp_path: Path, query: str, status: int, text: str
) -> None:
    async with robot(tmp_path) as url:
        answer = await fetch(url, "GET", f"/goals?{query}")
        assert (answer.status, text in answer.json["detail"]) == (status, True)


async def test_a_client_finds_goals_of_actions_that_it_may_observe(tmp_path: Path) -> None:
    def authorize(_peer: Peer, action: str, permission: Permission) -> bool:
        return permission is not Permission.OBSERVE or action == "drive"

    async with robot(tmp_path, authorize=authorize) as url:
        assert await search(url) == (1, ["drive"])
        assert (await fetch(url, "GET", "/goals?action=arm/pick")).status == 403


@pytest.mark.parametrize("is_known", [True, False])
async def test_servers_that_cannot_be_asked_are_named(
    monkeypatch: pytest.MonkeyPatch, is_known: bool
) -> None:
    monkeypatch.setattr(Unreachable, "is_known", is_known)
    async with ActionServer(DRIVE, work) as drive, ActionServer(PICK, work) as pick:
        async with served(Unreachable(drive), pick) as url:
            await fetch(url, "POST", "/actions/arm/pick/goals?wait=20", 1)
            answer = (await fetch(url, "GET", "/goals")).json
            assert (answer["total"], answer["away"]) == (1, ["drive"])
