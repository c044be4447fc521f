"""The same work by DBOS: one durable workflow with one step for each goal, in a file of SQLite.

DBOS makes an exception of SQLite, for development: its database of choice is Postgres.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

MISSING = "" if find_spec("dbos") else "it is not installed; `make bench` installs it"
"""The reason why DBOS cannot take part; empty if it can."""


@asynccontextmanager
async def launched(path: Path) -> AsyncIterator[Callable[[int], Awaitable[Any]]]:
    """Launch DBOS with a file of its own, and yield a workflow."""
    from dbos import DBOS

    DBOS(
        config={
            "name": "benchmark",
            "system_database_url": f"sqlite:///{path}",
            "log_level": "ERROR",
        }
    )

    @DBOS.step()  # type: ignore[untyped-decorator, unused-ignore]  # DBOS is not installed for checks
    async def step(number: int) -> str:
        return f"done {number}"

    @DBOS.workflow()  # type: ignore[untyped-decorator, unused-ignore]  # as above
    async def workflow(number: int) -> str:
        done: str = await step(number)
        return done

    DBOS.launch()
    try:
        yield workflow
    finally:
        DBOS.destroy()
