"""fibaction over `inproc://`, with the server in the client's process."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import fibaction
from fibaction import ActionServer
from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.contender import Contender
from tests.tools.benchmarks.inprocess import ACTION, count


@asynccontextmanager
async def connect(address: str, **settings: Any) -> AsyncGenerator[Contender, None]:
    """Serve; `settings` are the server's."""
    server = ActionServer(ACTION, count, stall_timeout=math.inf, **settings)
    async with (
        fibaction.serve(server, "inproc://benchmark") as (url,),
        over_fibaction.connect(url) as contender,
    ):
        yield contender
