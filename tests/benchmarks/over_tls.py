"""fibaction over `tls://`: as over TCP, and the server has a certificate that the client checks."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

import fibaction
from fibaction import ActionServer
from tests.benchmarks.inprocess import ACTION, count
from tests.benchmarks.over_fibaction import connect as connect
from tests.certificates import HOST, pems


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    server = ActionServer(ACTION, count, stall_timeout=math.inf)
    files = pems()
    async with fibaction.serve(server, f"tls://{HOST}:0?cert={files.cert}") as (url,):
        yield f"{url}?ca={files.ca}"
