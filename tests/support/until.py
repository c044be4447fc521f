"""Waiting for what tells of no change, and has to be looked at again."""

from __future__ import annotations

from collections.abc import Callable

import anyio


async def until(look: Callable[[], object], *expected: object) -> None:
    """Wait until what is looked at is true, or what is expected."""
    while not (look() == expected[0] if expected else look()):  # noqa: ASYNC110  # it tells nothing
        await anyio.sleep(0.01)
