"""`statuses_soon`: the goals that a server knows, from a server that answers soon or not at all."""

from __future__ import annotations

import anyio

from fibaction.border.endpoints import Endpoint
from fibaction.border.streams import StatusStream
from fibaction.words.errors import ServerNotFound

ANSWERING = 5.0
"""Seconds within which a server answers, also if it is busy."""


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
