"""fibaction over `inproc://`: the server is where the client is."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import fibaction
from fibaction import ActionServer
from tests.benchmarks.contender import Contender
from tests.benchmarks.inprocess import ACTION, count
from tests.benchmarks.over_fibaction import connect as connect_to


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    server = ActionServer(ACTION, count, stall_timeout=math.inf)
    async with (
        fibaction.serve(server, "inproc://benchmark") as (url,),
        connect_to(url) as contender,
    ):
        yield contender
