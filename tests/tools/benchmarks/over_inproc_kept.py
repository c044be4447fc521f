"""fibaction over `inproc://`, as in `over_inproc`, with every result kept."""

from __future__ import annotations

import math
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from tests.tools.benchmarks import over_inproc
from tests.tools.benchmarks.contender import Contender

KEPT: dict[str, Any] = {"result_timeout": math.inf, "max_results": 1_000_000}
"""The settings of a server that keeps all results for ever."""


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with over_inproc.connect(address, **KEPT) as contender:
        yield contender
