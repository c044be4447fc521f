"""fibaction over `ws://`."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.over_fibaction import connect as connect


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_fibaction.serve("ws://127.0.0.1:0") as url:
        yield url
