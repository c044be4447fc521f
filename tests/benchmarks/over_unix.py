"""fibaction over `unix://`."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import fibaction
from fibaction import ActionServer
from tests.benchmarks.inprocess import ACTION, count
from tests.benchmarks.over_fibaction import connect as connect


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    server = ActionServer(ACTION, count, stall_timeout=math.inf)
    with TemporaryDirectory() as folder:
        async with fibaction.serve(server, f"unix://{Path(folder, 'socket')}") as (url,):
            yield url
