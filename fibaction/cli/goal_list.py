"""Goals as a list: those of one action or of all, in columns, and one picked out by its ID."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import anyio
import msgspec

from fibaction._api import ClientConnection
from fibaction.action import Action, ActionInfo
from fibaction.cli.app import find_action, shown
from fibaction.cli.ending import ExitCode, Failure, sentence_of
from fibaction.cli.escaping import clean
from fibaction.cli.output import note
from fibaction.client import ActionClient
from fibaction.exceptions import ActionError
from fibaction.goals import GoalID, GoalInfo

SHORT = 8
"""Digits of a goal's ID where there is no room for all 32; more if those are not enough to tell
the goals apart."""
GAP = "  "

AnyClient: TypeAlias = ActionClient[Any, Any, Any]


class Row(msgspec.Struct, frozen=True):
    """A goal, and the action that it is of."""

    action: str
    info: GoalInfo

    @property
    def goal_id(self) -> str:
        """The goal's ID as text."""
        return str(self.info.goal_id)

    @property
    def feedback(self) -> str:
        """How many feedback messages there were; ROS, which names no clients, does not say."""
        count, client = self.info.feedback_count, self.info.client
        return str(count) if count or client else "-"

    @property
    def client(self) -> str:
        """Who sent it."""
        return clean(self.info.client) or "-"

    @property
    def rank(self) -> tuple[bool, int]:
        """To sort by, where not all goals fit: active ones first, and among each the newest."""
        return not self.info.status.is_active, -self.info.stamp

    def age(self, now: float) -> str:
        """How long ago it was accepted, if the clocks agree."""
        return duration(now - self.info.stamp / 1e9)

    def json(self) -> dict[str, Any]:
        """The row for a program."""
        info = self.info
        return {
            "action": self.action,
            "goal_id": self.goal_id,
            "stamp": info.stamp,
            "status": info.status.name,
            "feedback_count": info.feedback_count,
            "client": info.client,
        }


def duration(seconds: float) -> str:
    """A time that has passed, as long as it need be for a person."""
    if seconds < 10:
        return f"{max(seconds, 0):.1f} s"
    for unit, size, most in (("s", 1, 120), ("min", 60, 120), ("h", 3600, 48)):
        if seconds < size * most:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} d"


# Finding


class Clients:
    """A client for each action that is served, or for the one that is asked for."""

    def __init__(self, connection: ClientConnection, name: str | None = None) -> None:
        self._connection = connection
        self._name = name
        self._all: dict[str, AnyClient | None] = {}

    async def now(self) -> dict[str, AnyClient]:
        """Those that there are now. An action that cannot be used from here, because its ROS type
        is not installed, is told of and left out.

        Raises:
            Failure: Nobody serves the one that is asked for.
            ActionError: The server cannot be asked, or the one cannot be used from here.
        """
        if self._name is not None:
            if not self._all:
                info = await find_action(self._connection, self._name)
                self._all[info.name] = self._connection.client(Action.untyped(info))
            actions = list(self._all)
        else:
            infos = sorted(await self._connection.actions(), key=lambda info: shown(info.name))
            for info in infos:
                if info.name not in self._all:
                    self._all[info.name] = self._client(info)
            actions = [info.name for info in infos]
        found = ((name, self._all[name]) for name in actions)
        return {name: client for name, client in found if client is not None}

    def _client(self, info: ActionInfo) -> AnyClient | None:
        try:
            return self._connection.client(Action.untyped(info))
        except ActionError as exc:
            note(f"{shown(info.name)} is left out: {sentence_of(exc)}")
            return None


async def goals_of(clients: Mapping[str, AnyClient]) -> list[Row]:
    """All goals of these clients' servers: those accepted first come first.

    Raises:
        ActionError: None of them can be asked. If only some cannot, they are left out: they have
            gone in the meantime.
    """
    rows: list[Row] = []
    errors: list[ActionError] = []

    async def ask(name: str, client: AnyClient) -> None:
        try:
            rows.extend(Row(name, info) for info in await client.goals())
        except ActionError as exc:
            errors.append(exc)

    async with anyio.create_task_group() as tasks:
        for name, client in clients.items():
            tasks.start_soon(ask, name, client)
    if errors and len(errors) == len(clients):
        raise errors[0]
    return sorted(rows, key=lambda row: row.info.stamp)


def goal_digits(text: str) -> str:
    """The digits of a goal's ID, or of its beginning.

    Raises:
        Failure: It is nothing like that.
    """
    digits = text.replace("-", "").lower()
    if not digits or len(digits) > 32 or set(digits) - set("0123456789abcdef"):
        raise Failure(
            f"a goal ID has 32 hexadecimal digits, or is the beginning of one, unlike {text!r}",
            ExitCode.USAGE,
        )
    return digits


async def pick(clients: Mapping[str, AnyClient], digits: str) -> tuple[str, GoalID]:
    """The goal whose ID begins so, and its action. If several do, an active one is meant.

    Raises:
        Failure: There is none, or more than one.
        ActionError: The server cannot be asked.
    """
    if len(digits) == 32 and len(clients) == 1:
        return next(iter(clients)), GoalID.parse(digits)  # even if it is not yet accepted
    found = [row for row in await goals_of(clients) if row.goal_id.startswith(digits)]
    if len(found) > 1:
        found = [row for row in found if row.info.status.is_active] or found
    if not found:
        where = f"the server of {shown(next(iter(clients)))}" if len(clients) == 1 else "any server"
        raise Failure(f"there is no goal {digits} at {where}", ExitCode.USAGE)
    if len(found) > 1:
        ids = ", ".join(row.goal_id for row in found[:5])
        more = ", ..." if len(found) > 5 else ""
        raise Failure(
            f"{len(found)} goals have an ID that begins with {digits}: {ids}{more}", ExitCode.USAGE
        )
    return found[0].action, found[0].info.goal_id


# Laying out


def in_columns(
    rows: Sequence[Row], *, actions: bool, width: int | None = None, now: float | None = None
) -> list[str]:
    """The rows as lines, below one that names the columns. With `width`, they are made to fit."""
    now = time.time() if now is None else now
    digits = 32
    table = _cells(rows, digits, now, actions=actions)
    if width is not None and _width(table) > width:
        digits = unambiguous(row.goal_id for row in rows)
        table = _cells(rows, digits, now, actions=actions)
    spare = None if width is None else width - _width(table)
    if spare is not None and spare < 0:
        table = [_narrowed(cells, table, -spare, actions=actions) for cells in table]
    return [_joined(cells, _widths(table)) for cells in table]


def unambiguous(goal_ids: Iterable[str]) -> int:
    """How many digits tell these IDs apart: `SHORT` at least."""
    ids = sorted(set(goal_ids))
    digits = SHORT
    for one, next_one in pairwise(ids):
        while one[:digits] == next_one[:digits]:
            digits += 1
    return digits


def _cells(rows: Iterable[Row], digits: int, now: float, *, actions: bool) -> list[list[str]]:
    table = [["ID", "ACTION", "STATUS", "AGE", "FEEDBACK", "CLIENT"]]
    for row in rows:
        action, info = clean(shown(row.action)), row.info
        cells = [row.goal_id[:digits], action, info.status.name, row.age(now)]
        table.append([*cells, row.feedback, row.client])
    return table if actions else [[cells[0], *cells[2:]] for cells in table]


def _widths(table: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*table, strict=True)]


def _width(table: Sequence[Sequence[str]]) -> int:
    widths = _widths(table)
    return sum(widths) + len(GAP) * (len(widths) - 1)


def _narrowed(
    cells: Sequence[str], table: Sequence[Sequence[str]], excess: int, *, actions: bool
) -> list[str]:
    """The cells, with the longest of those shortened that may be."""
    widths = _widths(table)
    narrowed = list(cells)
    # The client first: the name of the action is what people look for.
    for column in (-1, 1) if actions else (-1,):
        room = max(widths[column] - excess, SHORT)
        excess -= widths[column] - room
        if len(narrowed[column]) > room:
            narrowed[column] = narrowed[column][: room - 1] + "…"
    return narrowed


def _joined(cells: Sequence[str], widths: Sequence[int]) -> str:
    # Ages and counts to the right.
    last = len(cells) - 1
    padded = (
        cell.rjust(width) if last - 2 <= place < last else cell.ljust(width)
        for place, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return GAP.join(padded).rstrip()
