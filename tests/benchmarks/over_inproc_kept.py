"""As `over_inproc`, and every result is kept."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import fibaction
from fibaction import ActionServer
from tests.benchmarks.contender import Contender
from tests.benchmarks.inprocess import ACTION, count
from tests.benchmarks.over_fibaction import connect as connect_to

KEPT = 1_000_000
"""More results than there are."""


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    server = ActionServer(ACTION, count, result_timeout=math.inf, max_results=KEPT)
    async with (
        fibaction.serve(server, "inproc://benchmark") as (url,),
        connect_to(url) as contender,
    ):
        yield contender
