"""fibaction over `tls://`, with a certificate of the server that the client checks."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tests.support.certificates import HOST, pems
from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.over_fibaction import connect as connect


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    files = pems()
    async with over_fibaction.serve(f"tls://{HOST}:0?cert={files.cert}") as url:
        yield f"{url}?ca={files.ca}"
