"""Record a store of this release, which later releases must be able to read.

    python -m tests.stores.record_goals

It writes `tests/stores/recorded/version_N.sql`, where N is the version of the file: the first goal
has ended, the second one runs and has a checkpoint, and the third one waits for it. A version that
was published is never recorded again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import AsyncGenerator
from contextlib import closing
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import anyio

from fibaction import Action, ActionClient, ActionServer, GoalHandle, GoalID, Schedule, SqliteStore
from fibaction.stores._journal_file import APPLICATION, VERSION

RECORDED = Path(__file__).with_name("recorded")
PAINT = Action("paint", goal=int, feedback=int, result=str, checkpoint=int)
A_HUNDRED_YEARS = 100 * 365 * 24 * 60 * 60.0
ENDED, RUNNING, WAITING = (GoalID(bytes(15) + bytes([number])) for number in (1, 2, 3))


async def paint(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    await goal.checkpoint(10 * goal.request)
    yield 0
    if goal.request == 2:
        await anyio.sleep_forever()
    yield "painted"


async def _record(folder: Path) -> Path:
    """Return a copy of the store, as it is while the second goal runs."""
    path, copy = folder / "goals.db", folder / "copy.db"
    server = ActionServer(
        PAINT,
        paint,
        store=SqliteStore(path),
        schedule=Schedule(concurrency=1, queue=5),
        result_timeout=A_HUNDRED_YEARS,  # the time of its expiry is in the record of an end
    )
    async with server:
        client = ActionClient(server, PAINT)
        ended = await client.send_goal(1, goal_id=ENDED)
        await ended.result()
        running = await client.send_goal(2, goal_id=RUNNING)
        await anext(running.feedback)
        waiting = await client.send_goal(3, goal_id=WAITING)
        for suffix in ("", "-wal"):
            copyfile(f"{path}{suffix}", f"{copy}{suffix}")
        await waiting.cancel()
        await running.cancel()
    return copy


def main() -> None:
    """Write the record of this version."""
    with TemporaryDirectory() as folder:
        copy = anyio.run(_record, Path(folder))
        with closing(sqlite3.connect(copy)) as db:
            lines = [
                f"PRAGMA application_id={APPLICATION};",
                f"PRAGMA user_version={VERSION};",
                *db.iterdump(),
            ]
    RECORDED.mkdir(exist_ok=True)
    (RECORDED / f"version_{VERSION}.sql").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
