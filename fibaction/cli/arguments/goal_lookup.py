"""Lookup of goals: of some actions or of all, those that a user chooses, and one by its ID."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, NamedTuple

import anyio
import click

from fibaction._api import ClientConnection
from fibaction.cli.arguments.names import action_of, shown
from fibaction.cli.arguments.options import TimeType, labels_option
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.lines import note
from fibaction.cli.process.exit_codes import Failure, message_of
from fibaction.observe.monitor import AnyClient, newest_active_first
from fibaction.types.action import Action, ActionInfo
from fibaction.words.errors import ActionError
from fibaction.words.goal_query import (
    ANY_GOAL,
    SORTS,
    STATUSES,
    GoalQuery,
    Labels,
    sort_key,
    words_of,
)
from fibaction.words.goals import GoalID, GoalInfo
from fibaction.words.statuses import GoalStatus

ACTIONS_ASKED_AT_ONCE = 100
"""Actions that are asked at the same time: a server limits the requests of a connection."""
USUAL_LIMIT = 100
"""Goals that are listed if nothing else is said."""
STATUS_WORDS = {word.lower(): statuses for word, statuses in STATUSES.items()}
"""The statuses that each word of `--status` means."""

BY_ACTION = "action"
"""The order of a list by the names of the actions, which goes with those of `SORTS`."""


class GoalChoice(NamedTuple):
    """The goals of a list that are printed, and their order."""

    words: tuple[str, ...] = ()
    """The words for their statuses, as the user has typed them; none for any."""
    wanted: GoalQuery = ANY_GOAL
    limit: int = 0
    """The most goals; 0 for any number."""
    sort: str = ""
    """The name of their order in `SORTS`, or `BY_ACTION`; empty for that of their acceptance."""
    past: bool = False
    """True for the goals in the histories of the servers as well."""

    @property
    def adjective(self) -> str:
        """Words that go before "goals" in a sentence; empty if any goal is wanted."""
        if self.wanted != GoalQuery(self.wanted.statuses):
            return "matching "
        return " or ".join(self.words) + " " if self.words else ""

    def of(self, rows: list[GoalRow]) -> tuple[list[GoalRow], int]:
        """Return the chosen ones of these rows, and the number of those beyond the limit.

        The rows come in the order of acceptance. Without another order, the limit leaves the active
        and the newest ones; else it leaves the last ones. Goals whose key is not known come
        first.
        """
        found = [row for row in rows if self.wanted.at(row.action).has(row.info)]
        left_out = max(len(found) - self.limit, 0) if self.limit else 0
        if self.sort:
            return sorted(found, key=self._key)[left_out:], left_out
        if left_out:
            found = sorted(found, key=lambda row: newest_active_first(row.info))[: self.limit]
            found.sort(key=lambda row: row.info.stamp)
        return found, left_out

    def _key(self, row: GoalRow) -> Any:
        return shown(row.action) if self.sort == BY_ACTION else sort_key(self.sort, row.info)


DEFAULT = GoalChoice(limit=USUAL_LIMIT)
"""The goals that are listed if nothing else is said."""


def choice_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add the options that choose goals and order them. The function gets them as `choice`."""

    @click.option(
        "--status",
        "words",
        type=click.Choice(tuple(STATUS_WORDS), case_sensitive=False),
        multiple=True,
        help="List the goals with this status only; may be given several times.",
    )
    @click.option(
        "--client", metavar="TEXT", default="", help="List the goals whose CLIENT contains TEXT."
    )
    @labels_option("List the goals with this label only; given several times, with all of them.")
    @click.option("--since", type=TimeType(), help="List the goals accepted at that time or later.")
    @click.option("--until", type=TimeType(), help="List those accepted at that time or earlier.")
    @click.option(
        "--search",
        metavar="WORDS",
        default="",
        help="List the goals that have each of these words in their action, ID, status, client,"
        " worker, reason, labels or parent.",
    )
    @click.option(
        "--sort",
        type=click.Choice((*SORTS, BY_ACTION)),
        help="Sort in ascending order by this property.",
    )
    @click.option(
        "--limit",
        type=click.IntRange(min=0),
        default=USUAL_LIMIT,
        help="List at most so many goals: active and newest ones, or the last of --sort; 0 for"
        f" all.  [default: {USUAL_LIMIT}]",
    )
    @click.option(
        "--past",
        is_flag=True,
        help="Also list the goals that the server has forgotten and that its store has in the"
        " history.",
    )
    @wraps(function)
    def choosing(
        words: tuple[str, ...],
        client: str,
        labels: Labels,
        since: int | None,
        until: int | None,
        sort: str | None,
        limit: int,
        past: bool,
        **others: Any,
    ) -> None:
        if since is not None and until is not None and since > until:
            raise Failure("--since is later than --until: no goal is between them")
        statuses = frozenset[GoalStatus]().union(*(STATUS_WORDS[word] for word in words))
        wanted = GoalQuery(statuses, client, since, until, labels, words_of(others.pop("search")))
        function(choice=GoalChoice(words, wanted, limit, sort or "", past), **others)

    return choosing


class ActionClients:
    """A client for each action that is served, or for those that the user names."""

    def __init__(self, connection: ClientConnection, *names: str | None) -> None:
        """Name the actions; None names none."""
        self._connection = connection
        self._names = [name for name in names if name is not None]
        self._all: dict[str, AnyClient | None] = {}

    async def now(self) -> dict[str, AnyClient]:
        """Return the clients of the actions that are served now, by name.

        An action that cannot be used from here, because its ROS type is not installed, is left out
        with a remark.

        Raises:
            Failure: A named action is not served.
            ActionError: The server cannot be asked, or a named action cannot be used from here.
        """
        if self._names:
            if not self._all:
                actions = await self._connection.actions()
                for info in [action_of(name, actions) for name in self._names]:
                    self._all[info.name] = self._connection.client(Action.untyped(info))
            names = list(self._all)
        else:
            infos = sorted(await self._connection.actions(), key=lambda info: shown(info.name))
            for info in infos:
                if info.name not in self._all:
                    self._all[info.name] = self._client(info)
            names = [info.name for info in infos]
        found = ((name, self._all[name]) for name in names)
        return {name: client for name, client in found if client is not None}

    def _client(self, info: ActionInfo) -> AnyClient | None:
        try:
            return self._connection.client(Action.untyped(info))
        except ActionError as exc:
            note(f"{shown(info.name)} is left out: {message_of(exc)}")
            return None


async def goals_of(clients: Mapping[str, AnyClient]) -> list[GoalRow]:
    """Return all goals of these clients' servers, in the order in which they were accepted.

    Servers that cannot be asked are left out: they have stopped in the meantime.

    Raises:
        ActionError: None of them can be asked.
    """
    rows: list[GoalRow] = []
    errors: list[ActionError] = []

    async def ask(name: str, client: AnyClient) -> None:
        try:
            async with limit:
                rows.extend(GoalRow(name, info) for info in await client.goals())
        except ActionError as exc:
            errors.append(exc)

    limit = anyio.CapacityLimiter(ACTIONS_ASKED_AT_ONCE)
    async with anyio.create_task_group() as tasks:
        for name, client in clients.items():
            tasks.start_soon(ask, name, client)
    if errors and len(errors) == len(clients):
        raise errors[0]
    return sorted(rows, key=lambda row: row.info.stamp)


async def with_past(
    clients: Mapping[str, AnyClient], rows: list[GoalRow], wanted: GoalQuery
) -> list[GoalRow]:
    """Return the goals that the servers remember and those in their histories that are wanted, each
    once, in the order in which they were accepted.

    Raises:
        ActionError: One of them cannot be asked.
    """
    found = {
        (name, info.stamp, info.goal_id): GoalRow(name, info)
        for name, client in clients.items()
        for info in await _past_of(client, wanted.at(name))
    }
    found |= {(row.action, row.info.stamp, row.info.goal_id): row for row in rows}
    return sorted(found.values(), key=lambda row: row.info.stamp)


async def _past_of(client: AnyClient, wanted: GoalQuery) -> list[GoalInfo]:
    infos: list[GoalInfo] = []
    await client.endpoint.read_past(wanted, infos.extend)
    return infos


def goal_digits(text: str) -> str:
    """Return the digits of a goal's ID, or of its beginning.

    Raises:
        Failure: The text is neither.
    """
    digits = text.replace("-", "").lower()
    if not digits or len(digits) > 32 or set(digits) - set("0123456789abcdef"):
        raise Failure(
            f"a goal ID has 32 hexadecimal digits, or is the beginning of one, unlike {text!r}"
        )
    return digits


async def find_goal(clients: Mapping[str, AnyClient], digits: str) -> tuple[str, GoalID]:
    """Return the action and the ID of the goal whose ID begins so; the active one if several do.

    Raises:
        Failure: There is no such goal, or more than one.
        ActionError: The server cannot be asked.
    """
    if len(digits) == 32 and len(clients) == 1:
        return next(iter(clients)), GoalID.parse(digits)  # even if it is not yet accepted
    found = [row for row in await goals_of(clients) if row.goal_id.startswith(digits)]
    if len(found) > 1:
        found = [row for row in found if row.info.status.is_active] or found
    if not found:
        where = f"the server of {shown(next(iter(clients)))}" if len(clients) == 1 else "any server"
        raise Failure(f"there is no goal {digits} at {where}")
    if len(found) > 1:
        ids = ", ".join(row.goal_id for row in found[:5])
        more = ", ..." if len(found) > 5 else ""
        raise Failure(f"{len(found)} goals have an ID that begins with {digits}: {ids}{more}")
    return found[0].action, found[0].info.goal_id
