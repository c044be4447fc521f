"""fibaction over `tls://`, with a certificate of the server that the client checks."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tests.benchmarks import over_fibaction
from tests.benchmarks.over_fibaction import connect as connect
from tests.certificates import HOST, pems


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    files = pems()
    async with over_fibaction.serve(f"tls://{HOST}:0?cert={files.cert}") as url:
        yield f"{url}?ca={files.ca}"
