"""`GET /goals`: a search for goals of all actions, those of the histories included."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import (
    Action,
    ActionServer,
    GoalAborted,
    GoalHandle,
    GoalHistory,
    Peer,
    Permission,
    SqliteStore,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint
from fibaction.border.endpoints import Absence
from fibaction.words.errors import ConnectionLost
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

PICK = Action("arm/pick", goal=int, feedback=int, result=str)
DRIVE = Action("drive", goal=int, feedback=int, result=str)


async def work(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    if goal.request == 0:
        raise GoalAborted("the gripper is OPEN")
    yield str(goal.request)


class Unreachable(ForwardingEndpoint):
    """An endpoint whose server does not answer, and one that is known to be away."""

    is_known = True

    @property
    def absence(self) -> Absence | None:
        return Absence(1.0, "no answer") if self.is_known else None

    async def status(self) -> Any:
        raise ConnectionLost("no answer")


@asynccontextmanager
async def robot(path: Path, **settings: Any) -> AsyncGenerator[str, None]:
    """Serve two actions: `arm/pick` forgets each goal at its end, and has a history."""
    store = SqliteStore(path / "goals.db", history=GoalHistory())
    with anyio.fail_after(30):
        pick = ActionServer(PICK, work, store=store, result_timeout=0)
        drive = ActionServer(DRIVE, work)
        async with serve([pick, drive], "http://127.0.0.1:0", **settings) as (url,):
            for number in range(5):
                label = f"label=order={number}"
                await fetch(url, "POST", f"/actions/arm/pick/goals?wait=20&{label}", number)
            await fetch(url, "POST", "/actions/drive/goals?wait=20", 7)
            yield url


async def search(url: str, query: str = "") -> tuple[int, list[str]]:
    """The number of all goals that a search finds, and the orders of those on its page."""
    answer = await fetch(url, "GET", f"/goals?{query}")
    assert answer.status == 200, answer.json
    orders = [goal.get("labels", {}).get("order", goal["action"]) for goal in answer.json["goals"]]
    return answer.json["total"], orders


async def test_goals_of_all_actions_are_found_with_their_number(tmp_path: Path) -> None:
    async with robot(tmp_path) as url:
        assert await search(url) == (6, ["drive", "4", "3", "2", "1", "0"])
        assert await search(url, "limit=2&offset=1") == (6, ["4", "3"])
        assert await search(url, "sort=accepted&limit=2") == (6, ["0", "1"])
        assert await search(url, "sort=-status&limit=1") == (6, ["0"])
        assert await search(url, "search=PICK%20gripper") == (1, ["0"])
        assert await search(url, "action=arm/pick&search=order%3D3") == (1, ["3"])
        assert await search(url, "label=order=2&status=ended") == (1, ["2"])
        assert await search(url, f"parent={1:032x}") == (0, [])


@pytest.mark.parametrize(
    ("query", "status", "text"),
    [
        ("sort=color", 400, "sort is one of accepted, began"),
        ("offset=-1", 400, "offset is a number of goals"),
        ("after=1", 400, "GET has no parameter 'after' here"),
        ("action=fly", 404, "there is no action 'fly'"),
    ],
)
async def test_a_search_that_is_wrong_says_what_is_right(
    tmp_path: Path, query: str, status: int, text: str
) -> None:
    async with robot(tmp_path) as url:
        answer = await fetch(url, "GET", f"/goals?{query}")
        assert (answer.status, text in answer.json["detail"]) == (status, True)


async def test_a_client_finds_goals_of_actions_that_it_may_observe(tmp_path: Path) -> None:
    def authorize(_peer: Peer, action: str, permission: Permission) -> bool:
        return permission is not Permission.OBSERVE or action == "drive"

    async with robot(tmp_path, authorize=authorize) as url:
        assert await search(url) == (1, ["drive"])
        assert (await fetch(url, "GET", "/goals?action=arm/pick")).status == 403


@pytest.mark.parametrize("is_known", [True, False])
async def test_servers_that_cannot_be_asked_are_named(
    monkeypatch: pytest.MonkeyPatch, is_known: bool
) -> None:
    monkeypatch.setattr(Unreachable, "is_known", is_known)
    with anyio.fail_after(20):
        async with ActionServer(DRIVE, work) as drive, ActionServer(PICK, work) as pick:
            async with serve([Unreachable(drive), pick], "http://127.0.0.1:0") as (url,):
                await fetch(url, "POST", "/actions/arm/pick/goals?wait=20", 1)
                answer = (await fetch(url, "GET", "/goals")).json
                assert (answer["total"], answer["away"]) == (1, ["drive"])
