"""The stores that earlier releases have written, served by this one."""

from __future__ import annotations

import sqlite3
from collections.abc import AsyncGenerator
from contextlib import closing
from pathlib import Path

import anyio
import pytest

from fibaction import ActionClient, ActionServer, GoalHandle, GoalStatus, Schedule, SqliteStore
from fibaction.stores._journal_file import VERSION
from tests.stores.record_goals import ENDED, PAINT, RECORDED, RUNNING, WAITING

pytestmark = pytest.mark.anyio


def test_the_file_of_this_release_is_recorded() -> None:
    assert RECORDED.joinpath(f"version_{VERSION}.sql").exists()


@pytest.fixture(params=sorted(RECORDED.iterdir()), ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A store as a release has left it when it was killed."""
    path = tmp_path / "goals.db"
    with closing(sqlite3.connect(path)) as db:
        db.executescript(request.param.read_text())
    return path


async def test_a_store_of_an_earlier_release_has_all_its_goals(path: Path) -> None:
    attempts: list[tuple[int, int | None]] = []

    async def paint(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        attempts.append((goal.request, goal.restored))
        yield 0
        yield "painted again"

    server = ActionServer(
        PAINT,
        paint,
        store=SqliteStore(path),
        recovery="rerun",
        schedule=Schedule(concurrency=1, queue=5),
    )
    with anyio.fail_after(20):
        async with server:
            client = ActionClient(server, PAINT)
            ends = [
                await (await client.attach(goal_id)).outcome()
                for goal_id in (ENDED, RUNNING, WAITING)
            ]

    assert [end.status for end in ends] == [GoalStatus.SUCCEEDED] * 3
    assert [end.result for end in ends] == ["painted", "painted again", "painted again"]
    assert attempts == [(2, 20), (3, None)]
