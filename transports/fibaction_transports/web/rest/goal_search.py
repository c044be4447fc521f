"""A search for goals of all actions: those that the servers know, and those of their histories.

The answer is one page, in the order that the client asks for, with the number of all goals that
were found.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import anyio
import msgspec

from fibaction.border.abc import Endpoint
from fibaction.border.http_access import Refused
from fibaction.feeds.goal_search import GoalSearch
from fibaction.words.errors import ServerFailed, TransportError
from fibaction.words.goal_query import SORTS, words_of
from fibaction_transports.web.rest.goal_list import Query, members_of, page_of

DEFAULT_LIMIT = 100
"""Goals of a page if nothing else is said."""
LARGEST_OFFSET = 10_000_000
"""Goals before a page, at most: more than any server has."""
SORT_WORDS = tuple(f"{sign}{name}" for name in SORTS for sign in ("", "-"))
"""The words for an order; with a dash in front, from the last to the first."""
SEARCHED_AT_ONCE = 20
"""Actions that are asked at the same time."""


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
