"""fibaction over `tcp://`, as in `over_fibaction`, with every result kept."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.over_fibaction import connect as connect
from tests.tools.benchmarks.over_inproc_kept import KEPT


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_fibaction.serve(**KEPT) as url:
        yield url
