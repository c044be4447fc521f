"""Questions to the servers of actions, of which one that is silent does not delay the others."""

from __future__ import annotations

from collections.abc import Iterable

import anyio

from fibaction.border.endpoints import Endpoint
from fibaction.border.streams import StatusStream
from fibaction.words.action_error import ActionError
from fibaction.words.errors import ServerNotFound
from fibaction.words.intake import Intake

ANSWERING = 5.0
"""Seconds within which a server answers, also if it is busy."""
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


async def statuses_soon(endpoint: Endpoint) -> StatusStream:
    """Return the statuses of all goals of an action, for a list that is waited for.

    A server that is frozen counts as away only after some heartbeats, and calls to it wait for it
    to come back.

    Raises:
        ServerNotFound: The server does not answer within `ANSWERING` seconds.
        ActionError: As for `Endpoint.status`.
    """
    with anyio.move_on_after(ANSWERING):
        return await endpoint.status()
    raise ServerNotFound(
        f"the server of {endpoint.info.name!r} has not answered for {ANSWERING:g} s: ask again"
    )
