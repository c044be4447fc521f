"""Both ends of an action over ROS, in the process of the tests."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio

from fibaction import ActionClient, ActionServer, GoalHandle, connect, serve
from fibaction_transports.ros2.ros_transport import RosTransport
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci
from tests.support.processes import PATIENCE


@asynccontextmanager
async def both_ends(
    where: str | RosTransport,
    execute: Callable[[GoalHandle[Goal]], AsyncGenerator[Feedback | Result, None]] = fibonacci,
    more: str = "",
    *,
    patience: float = PATIENCE,
    **settings: Any,
) -> AsyncGenerator[ActionClient[Goal, Feedback, Result], None]:
    """Serve an executor, and give a client, whose URL may have more settings at its end."""
    with anyio.fail_after(patience):
        async with (
            serve(ActionServer(FIBONACCI, execute, **settings), where),
            connect(f"{where}{more}" if isinstance(where, str) else where, FIBONACCI) as client,
        ):
            yield client
