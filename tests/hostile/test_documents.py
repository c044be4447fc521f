"""The worst JSON documents at each door that takes JSON: the event loop goes on, and all is told.

Each pause of a check is made to wait for a turn of the event loop. A check in the loop itself would
have no such turn, and one that does not pause would have too few of them.
"""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from typing import Any

import anyio
import anyio.from_thread
import pytest

from fibaction import ActionServer, GoalHandle
from fibaction.schema import turns
from fibaction.schema.check import STEPS, STEPS_PER_VALUE, TURN, Extent
from tests.doors import DOORS
from tests.hostile.documents import ANYTHING, DOCUMENTS, NUMBERS, TREE

pytestmark = pytest.mark.asyncio

SIZE = 2**17
"""Bytes of the largest message."""


async def end(goal: GoalHandle[Any]) -> AsyncGenerator[int, None]:
    yield 1


SERVED = {action.name: action for action in (TREE, NUMBERS, ANYTHING)}


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The turns of the loop so far, one for each pause of a check."""
    taken = [0]

    def take() -> None:
        taken[0] += 1

    monkeypatch.setattr(turns, "_pause", lambda: anyio.from_thread.run_sync(take))
    return taken


@pytest.mark.parametrize("name", DOCUMENTS)
@pytest.mark.parametrize("door", ["rest", "sse", "rosbridge", "mcp", "mcp http", "a2a"])
async def test_the_loop_goes_on_while_a_document_is_checked(
    door: str, name: str, pauses: list[int]
) -> None:
    document = DOCUMENTS[name]
    goal = json.loads(document.text(SIZE))
    size = Extent.of(goal).size

    with anyio.fail_after(60):
        async with DOORS[door](ActionServer(SERVED[document.action], end)) as way:
            told = await way.send(goal)
    assert (told.result is not None) == document.is_goal, told.reason
    # At most the steps of the check, and those of the search for what is wrong.
    assert pauses[0] <= (2 * STEPS + STEPS_PER_VALUE * size) / TURN + 2
    if document.action != "anything":  # which is not checked
        assert pauses[0] >= (
            size / TURN / 3 if document.is_goal and document.action == "tree" else 1
        )
