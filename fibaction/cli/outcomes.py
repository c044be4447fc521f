"""The outcomes of goals that have ended, for `fibaction goals`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import anyio
from msgspec.structs import replace

from fibaction.cli.escape import excerpt
from fibaction.cli.goal_table import GoalRow
from fibaction.cli.progress import on_one_line
from fibaction.exceptions import ActionError
from fibaction.goals import Outcome
from fibaction.monitor import AnyClient

MOST = 50
"""Goals whose outcomes are asked for, the newest: each is a request, and a result may be large."""
MOST_AT_ONCE = 10
TIMEOUT = 2.0
"""Seconds for all of them; the list is shown then, without those that have not come."""


async def with_outcomes(clients: Mapping[str, AnyClient], rows: Sequence[GoalRow]) -> list[GoalRow]:
    """Return the rows, those of the newest goals that have ended with their outcomes."""
    whole = {row.info.goal_id: row for row in rows}

    async def ask(row: GoalRow) -> None:
        client = clients[row.action]
        try:
            async with limit:
                raw = await client.endpoint.get_result(row.info.goal_id)
            result = None if raw.result is None else client.action.result.decode(raw.result)
        except ActionError:
            return  # it may be forgotten by now
        outcome = Outcome(raw.status, result, raw.reason)
        whole[row.info.goal_id] = replace(row, outcome=outcome, end=_text_of(outcome))

    ended = [row for row in rows if not row.info.status.is_active]
    limit = anyio.CapacityLimiter(MOST_AT_ONCE)
    with anyio.move_on_after(TIMEOUT):
        async with anyio.create_task_group() as tasks:
            for row in ended[-MOST:]:
                tasks.start_soon(ask, row)
    return list(whole.values())


def _text_of(outcome: Outcome[object]) -> str:
    """Return the reason; where there is none, the result on one line."""
    if outcome.reason:
        return excerpt(outcome.reason)
    return "" if outcome.result is None else excerpt(on_one_line(outcome.result))
