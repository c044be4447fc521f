"""Waiting for another process, where there is nothing to wait for but a second look."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

import anyio

from tests.ros2.stock.process import PATIENCE

T = TypeVar("T")
PAUSE = 0.05


async def eventually(
    look: Callable[[], Awaitable[T]], good: Callable[[T], object], patience: float = PATIENCE
) -> T:
    """Look until the result is good, and return it."""
    deadline = anyio.current_time() + patience
    while not good(seen := await look()):
        assert anyio.current_time() < deadline, f"it stays like this: {seen}"
        await anyio.sleep(PAUSE)
    return seen
