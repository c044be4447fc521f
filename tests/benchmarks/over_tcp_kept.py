"""As `over_fibaction`, and every result is kept."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import fibaction
from fibaction import ActionServer
from tests.benchmarks.inprocess import ACTION, count
from tests.benchmarks.over_fibaction import connect as connect
from tests.benchmarks.over_inproc_kept import KEPT


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    server = ActionServer(ACTION, count, result_timeout=math.inf, max_results=KEPT)
    async with fibaction.serve(server, "tcp://127.0.0.1:0") as (url,):
        yield url
