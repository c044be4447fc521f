"""`OneWorker`: a transport to a fleet of one worker."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from fibaction import WorkerInfo
from fibaction.border.abc import Connection
from fibaction_transports.inprocess import InProcessTransport

WORKER = WorkerInfo("robot7", ("count",), 0)


class OneWorker(InProcessTransport):
    """A transport whose connections know `WORKER`, for any event loop."""

    shares_event_loop = False

    @asynccontextmanager
    async def connect(self) -> AsyncGenerator[Connection, None]:
        async with super().connect() as connection:

            async def workers() -> list[WorkerInfo]:
                return [WORKER]

            connection.workers = workers  # type: ignore[method-assign]  # of this one only
            yield connection
