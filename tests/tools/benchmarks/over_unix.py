"""fibaction over `unix://`."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.over_fibaction import connect as connect


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    with TemporaryDirectory() as folder:
        async with over_fibaction.serve(f"unix://{Path(folder, 'socket')}") as url:
            yield url
