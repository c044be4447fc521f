"""fibaction over `nats://`: a worker of a fleet, and a client of it.

`FIBACTION_BENCH_FLEET` is the URL of the fleet, whose brokers must be running.
"""

from __future__ import annotations

import os
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from fibaction.cli.verbs.serve import rare_collections
from tests.tools.benchmarks import over_fibaction
from tests.tools.benchmarks.over_fibaction import connect as connect

FLEET = "FIBACTION_BENCH_FLEET"
MANY: dict[str, Any] = {"max_results": 1_000_000}
"""The settings of a server that forgets outcomes by their time only, as its peers do."""


@asynccontextmanager
async def serve(**settings: Any) -> AsyncGenerator[str, None]:
    with rare_collections():
        async with over_fibaction.serve(os.environ[FLEET], **MANY, **settings):
            yield os.environ[FLEET]
