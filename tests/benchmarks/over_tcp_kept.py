"""fibaction over `tcp://`, as in `over_fibaction`, with every result kept."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tests.benchmarks import over_fibaction
from tests.benchmarks.over_fibaction import connect as connect
from tests.benchmarks.over_inproc_kept import KEPT


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_fibaction.serve(**KEPT) as url:
        yield url
