"""The outcomes of goals that have ended, for `fibaction goals` and `fibaction top`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import anyio
from msgspec.structs import replace

from fibaction.cli.output.escape import excerpt
from fibaction.cli.output.goal_table import GoalRow
from fibaction.cli.output.progress import on_one_line
from fibaction.observe.monitor import AnyClient
from fibaction.words.errors import ActionError
from fibaction.words.goals import GoalID, Outcome

MOST_ENDS = 50
"""Goals whose outcomes are asked for, the newest: each is a request, and a result may be large."""
GOALS_ASKED_AT_ONCE = 10
ENDS_TIMEOUT = 2.0
"""Seconds for all of them; the list is shown then, without those that have not come."""


class Outcomes:
    """The outcomes of the newest goals that have ended, each asked for once."""

    def __init__(self, most: int = MOST_ENDS) -> None:
        self._most = most
        self._known: dict[GoalID, Outcome[Any]] = {}

    async def of(
        self,
        clients: Mapping[str, AnyClient],
        rows: Sequence[GoalRow],
        timeout: float = ENDS_TIMEOUT,
    ) -> list[GoalRow]:
        """Return the rows, those of the newest goals that have ended with their outcomes."""
        newest = [row for row in rows if not row.info.status.is_active][-self._most :]
        ids = {row.info.goal_id for row in newest}
        self._known = {key: one for key, one in self._known.items() if key in ids}
        limit = anyio.CapacityLimiter(GOALS_ASKED_AT_ONCE)

        async def ask(row: GoalRow) -> None:
            client, goal_id = clients[row.action], row.info.goal_id
            try:
                async with limit:
                    raw = await client.endpoint.get_result(goal_id)
            except ActionError:
                return  # it may be forgotten by now
            self._known[goal_id] = raw.readable(client.action.result.decode)

        with anyio.move_on_after(timeout):
            async with anyio.create_task_group() as tasks:
                for row in newest:
                    if row.info.goal_id not in self._known:
                        tasks.start_soon(ask, row)
        return [with_outcome(row, self._known.get(row.info.goal_id)) for row in rows]


def with_outcome(row: GoalRow, outcome: Outcome[Any] | None) -> GoalRow:
    """Return the row with an outcome."""
    return row if outcome is None else replace(row, outcome=outcome, end=end_of(outcome))


def end_of(outcome: Outcome[Any]) -> str:
    """Return the reason; where there is none, the result on one line."""
    if outcome.reason:
        return excerpt(outcome.reason)
    return "" if outcome.result is None else excerpt(on_one_line(outcome.result))
