"""Goals as JSON: the list of an action's goals, whole or in pages, and searches for goals of all
actions.

A list may be long, and many clients may ask for it at once. It is made in slices: one slice of one
list, for any client, in each turn of the event loop.

The pages are in the order of acceptance. A cursor is the stamp and the ID of the last goal of a
page, so it holds also when that goal is forgotten meanwhile.

With `past=true` the list also has the goals that the server has forgotten, and that its store has
in its history. It always comes in pages then, each with no more of the history than it needs.

The answer to a search is one page, in the order that the client asks for, with the number of all
goals that were found, those of the histories included.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from heapq import nsmallest
from time import perf_counter
from typing import NamedTuple, TypeAlias
from urllib.parse import urlencode

import anyio
import msgspec

from fibaction.border.abc import Endpoint, StatusStream
from fibaction.border.event_loop import SLICE
from fibaction.border.http_access import Refused
from fibaction.feeds.answers import GoalSearch
from fibaction.words.errors import ServerFailed, TransportError
from fibaction.words.goal_query import (
    ANY_GOAL,
    MOST_PAST,
    SORTS,
    STATUSES,
    GoalQuery,
    Labels,
    PastPage,
    label_of,
    time_of,
    words_of,
)
from fibaction.words.goals import NO_GOAL, GoalID, GoalInfo
from fibaction.words.meta import MAX_KEYS
from fibaction.words.statuses import GoalStatus

LARGEST_PAGE = 10_000
"""Goals of the largest page."""

LAST_TIME = 10**19 - 1
"""The latest time that a stamp can tell."""

Query: TypeAlias = Mapping[str, list[str]]
"""The parameters of a request, each with its values."""

_PAGE_CURSOR = re.compile(r"(\d{1,19})\.([0-9a-f]{32})", re.ASCII)
DEFAULT_LIMIT = 100
"""Goals of a page if nothing else is said."""
LARGEST_OFFSET = 10_000_000
"""Goals before a page, at most: more than any server has."""
SORT_WORDS = tuple(f"{sign}{name}" for name in SORTS for sign in ("", "-"))
"""The words for an order; with a dash in front, from the last to the first."""
SEARCHED_AT_ONCE = 20
"""Actions that are asked at the same time."""


class Page(NamedTuple):
    """The part of a list that a client asks for."""

    limit: int | None = None
    """The number of goals; None for all."""
    after: tuple[int, bytes] = (-1, b"")
    """The stamp and the ID of the goal before the first one."""
    parent: GoalID | None = None
    """The goal whose children are listed; None for all goals."""
    wanted: GoalQuery = ANY_GOAL
    """The goals that are listed."""
    past: bool = False
    """True for the goals of the history as well; then there is a limit."""

    def has(self, info: GoalInfo) -> bool:
        """Return whether a goal is on this page or on one after it."""
        if self.parent is not None and (info.parent is None or info.parent.goal_id != self.parent):
            return False
        return _place_of(info) > self.after and self.wanted.has(info)

    def next_query(self, cursor: str) -> str:
        """Return the query of the next page, which begins after this cursor. A time that was told
        as one before the request is told as it was then.
        """
        wanted = self.wanted
        parameters: list[tuple[str, object]] = [("limit", self.limit), ("after", cursor)]
        if self.parent is not None:
            parameters.append(("parent", str(self.parent)))
        if self.past:
            parameters.append(("past", "true"))
        parameters += [("status", status.name) for status in sorted(wanted.statuses)]
        if wanted.client:
            parameters.append(("client", wanted.client))
        parameters += [("label", f"{key}={value}") for key, value in wanted.labels]
        for name, time in (("since", wanted.since), ("until", wanted.until)):
            if time is not None:
                parameters.append((name, f"{min(max(time, 0), LAST_TIME):016}"))
        return f"?{urlencode(parameters)}"


@contextmanager
def refusing(name: str) -> Generator[None, None, None]:
    """Refuse the request if the text of a parameter is wrong, for which the block raises
    `ValueError`.
    """
    try:
        yield
    except ValueError as exc:
        raise Refused(400, f"{name}: {exc}") from None


def labels_in(query: Query) -> Labels:
    """Return the labels that the parameters of a request name.

    Raises:
        Refused: One of them is wrong.
    """
    with refusing("label"):
        labels = tuple(dict.fromkeys(map(label_of, query.get("label", []))))
    if len(labels) > MAX_KEYS:
        raise Refused(400, f"label is there {len(labels)} times, and {MAX_KEYS} are the limit")
    return labels


def page_of(query: Query, now: int) -> Page:
    """Return the page that the parameters of a request name: the number of its goals and the goal
    before them, and of which goals: by their parent, the words for their statuses, a part of their
    client, the span of their acceptance, and labels that they have.

    Raises:
        Refused: One of them is wrong.
    """
    one = {name: values[-1] for name, values in query.items()}
    times: dict[str, int | None] = {"since": None, "until": None}
    for name in one.keys() & times:
        with refusing(name):
            times[name] = time_of(one[name], now, is_local=False)
    client, labels = one.get("client", ""), labels_in(query)
    if client == "" and "client" in one:
        raise Refused(400, "client is a part of the text of a client, and not empty")
    wanted = GoalQuery(_statuses_in(query), client, times["since"], times["until"], labels)
    limit = one.get("limit")
    if limit is not None and not (limit.isascii() and limit.isdecimal() and int(limit[:9]) > 0):
        raise Refused(400, f"limit is a number of goals between 1 and {LARGEST_PAGE}")
    size = None if limit is None else min(int(limit[:9]), LARGEST_PAGE)
    past = one.get("past", "false")
    if past not in ("true", "false"):
        raise Refused(400, "past is true or false")
    page = Page(size, wanted=wanted)
    if past == "true":
        page = page._replace(past=True, limit=MOST_PAST if size is None else size)
    if "parent" in one:
        with refusing("parent is the ID of a goal"):
            page = page._replace(parent=GoalID.parse(one["parent"]))
        if page.parent == NO_GOAL:
            raise Refused(400, "parent is the ID of a goal, and that of zeros means all goals")
    if "after" not in one:
        return page
    found = _PAGE_CURSOR.fullmatch(one["after"])
    if found is None:
        raise Refused(400, "after is a cursor of the header Link of the page before")
    return page._replace(after=(int(found[1]), bytes.fromhex(found[2])))


def _statuses_in(query: Query) -> frozenset[GoalStatus]:
    words = query.get("status", [])
    if not set(words) <= STATUSES.keys():
        raise Refused(400, f"status is one of {', '.join(STATUSES)}, each in its own parameter")
    return frozenset[GoalStatus]().union(*(STATUSES[word] for word in words))


def members_of(info: GoalInfo) -> dict[str, object]:
    """Return a goal of a list as members of an object."""
    return facts_of(info) | {"place": info.place, "queue_length": info.queue_length}


def facts_of(info: GoalInfo) -> dict[str, object]:
    """Return a goal as members of an object, without its place among those that wait. The stamp is
    text: JavaScript would round such a number. What is not known is left out.
    """
    parent = info.parent
    optional = {
        "began_at": None if info.began_at is None else str(info.began_at),
        "ended_at": None if info.ended_at is None else str(info.ended_at),
        "waited": info.waited,
        "ran": info.ran,
        "parent": parent and {"goal_id": str(parent.goal_id), "step": parent.step},
        "labels": info.labels,
        "worker": info.worker,
    }
    return {
        "goal_id": str(info.goal_id),
        "stamp": str(info.stamp),
        "status": info.status.name,
        "attempt": info.attempt,
        "feedback_count": info.feedback_count,
        "client": info.client,
        "reason": info.reason,
        **{name: text for name, text in optional.items() if text not in (None, "", {})},
    }


async def past_of(endpoint: Endpoint, page: Page) -> list[GoalInfo]:
    """Return the goals of the history that may be on a page, and one more, if the page has them.

    Raises:
        ActionError: As for `Endpoint.past_goals`.
    """
    found: list[GoalInfo] = []
    is_last = not page.past
    after = page.after
    while not is_last and len(found) <= (page.limit or 0):
        asked = PastPage(page.wanted, MOST_PAST, after, newest_first=False)
        infos = await endpoint.past_goals(asked)
        found += [info for info in infos if page.has(info)]
        is_last = len(infos) < MOST_PAST
        after = after if is_last else _place_of(infos[-1])
    return found


async def listed(
    statuses: StatusStream, page: Page, turn: anyio.Lock, past: Iterable[GoalInfo] = ()
) -> tuple[bytes, str]:
    """Return a page as JSON, and the cursor of the next one; empty if there is none. A goal of the
    past that the statuses have as well is told as they do.

    Raises:
        ActionError: As for `StatusStream.receive`.
    """
    pause = _pauses(turn)
    of_past = {_place_of(info): info for info in past}
    found = await chosen(statuses, page, turn, of_past)
    found = [*of_past.values(), *found]
    has_more = page.limit is not None and len(found) > page.limit
    if page.limit is not None:
        found = nsmallest(page.limit, found, key=_place_of)
    parts: list[bytes] = []
    for info in found:
        parts.append(msgspec.json.encode(members_of(info)))
        await pause()
    last = f"{found[-1].stamp}.{found[-1].goal_id}" if has_more else ""
    return b"[" + b",".join(parts) + b"]", last


async def chosen(
    statuses: StatusStream,
    page: Page,
    turn: anyio.Lock,
    past: dict[tuple[int, bytes], GoalInfo] | None = None,
) -> list[GoalInfo]:
    """Return the goals that a server knows now and that are on a page or after it; each goal that
    it knows is removed from those of the past.

    Raises:
        ActionError: As for `StatusStream.receive`.
    """
    pause = _pauses(turn)
    found: list[GoalInfo] = []
    for _ in range(statuses.known):
        info = await statuses.receive()
        if info is None:
            break
        if past:
            past.pop(_place_of(info), None)
        if page.has(info):
            found.append(info)
        await pause()
    return found


def _place_of(info: GoalInfo) -> tuple[int, bytes]:
    return info.stamp, info.goal_id


def _pauses(turn: anyio.Lock) -> Callable[[], Awaitable[None]]:
    """Return what waits for the next slice when one is over."""
    ends = perf_counter() + SLICE

    async def pause() -> None:
        nonlocal ends
        if perf_counter() >= ends:
            async with turn:  # which has one of those that wait in each turn of the event loop
                pass
            ends = perf_counter() + SLICE

    return pause


class Search(NamedTuple):
    """The search of a client."""

    actions: frozenset[str]
    """The names of the actions; empty for all."""
    goals: GoalSearch


def search_of(query: Query, now: int) -> Search:
    """Return the search that the parameters of a request name.

    Raises:
        Refused: One of them is wrong.
    """
    one = {name: values[-1] for name, values in query.items()}
    page = page_of(query, now)
    wanted = page.wanted._replace(words=words_of(one.get("search", "")))
    sort, offset = one.get("sort", "-accepted"), one.get("offset", "0")
    if sort not in SORT_WORDS:
        raise Refused(400, f"sort is one of {', '.join(SORTS)}; with - in front, the last first")
    if not (offset.isascii() and offset.isdecimal() and int(offset[:9]) <= LARGEST_OFFSET):
        raise Refused(400, f"offset is a number of goals between 0 and {LARGEST_OFFSET}")
    goals = GoalSearch(
        *(wanted, sort.removeprefix("-")),
        descending=sort.startswith("-"),
        offset=int(offset[:9]),
        limit=page.limit or DEFAULT_LIMIT,
        parent=page.parent,
    )
    return Search(frozenset(query.get("action", ())), goals)


async def found_by(search: GoalSearch, endpoints: Iterable[Endpoint]) -> bytes:
    """Return the page of a search as JSON. Servers that cannot be asked are named in it."""
    away: list[str] = []

    async def ask(endpoint: Endpoint) -> None:
        try:
            async with limit:
                await search.ask(endpoint)
        except (TransportError, ServerFailed):
            away.append(endpoint.info.name)

    limit = anyio.CapacityLimiter(SEARCHED_AT_ONCE)
    async with anyio.create_task_group() as tasks:
        for endpoint in endpoints:
            if endpoint.absence is None:
                tasks.start_soon(ask, endpoint)
            else:
                away.append(endpoint.info.name)
    goals = [{"action": action, **members_of(info)} for action, info in await search.page()]
    return msgspec.json.encode({"total": search.total, "goals": goals, "away": sorted(away)})
