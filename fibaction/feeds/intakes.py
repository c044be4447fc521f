"""`intakes_of`: how the actions of a list take goals."""

from __future__ import annotations

from collections.abc import Iterable

import anyio

from fibaction.border.endpoints import Endpoint
from fibaction.words.action_error import ActionError
from fibaction.words.intake import Intake

ASKED_AT_ONCE = 100
"""Actions that are asked at the same time."""
INTAKES_TIMEOUT = 2.0
"""Seconds after which a list does not wait for more answers."""


async def intakes_of(endpoints: Iterable[Endpoint]) -> dict[str, Intake]:
    """Return how actions take goals, by their names.

    One that does not answer in time, or not to this client, is left out.
    """
    found: dict[str, Intake] = {}
    limit = anyio.CapacityLimiter(ASKED_AT_ONCE)

    async def ask(endpoint: Endpoint) -> None:
        try:
            async with limit:
                found[endpoint.info.name] = await endpoint.intake()
        except ActionError:
            return

    with anyio.move_on_after(INTAKES_TIMEOUT):
        async with anyio.create_task_group() as tasks:
            for endpoint in endpoints:
                if endpoint.absence is None:
                    tasks.start_soon(ask, endpoint)
    return found
