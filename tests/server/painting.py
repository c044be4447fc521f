"""Goals that paint so many strokes, and stores that have them, for tests of goals that are kept."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any, TypeAlias

import anyio

from fibaction import Action, ActionClient, ActionServer, GoalHandle, GoalID
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import UNKNOWN_SENDER, digest_of
from tests.server.held import id_of
from tests.support.memory_store import MemoryStore

PAINT = Action("paint", goal=int, feedback=int, result=str, checkpoint=int)
Painting: TypeAlias = AsyncGenerator[int | str, None]
Server: TypeAlias = ActionServer[int, int, str]
ID = GoalID(bytes(15) + b"\1")


async def paint(goal: GoalHandle[int]) -> Painting:
    """Paint one stroke a second, from the last checkpoint on."""
    for done in range(goal.restored or 0, goal.request):
        yield done
        await anyio.sleep(1)
        await goal.checkpoint(done + 1)
    yield f"painted {goal.request} in attempt {goal.attempt}"


def server_with(store: MemoryStore, executor: Any = paint, **settings: Any) -> Server:
    return ActionServer(PAINT, executor, store=store, **settings)


def client_of(server: Server) -> ActionClient[int, int, str]:
    return ActionClient(server, PAINT)


def stored(request: Any = 3, number: int = 1, **fields: Any) -> StoredGoal:
    """Return a goal as an earlier process, or another server, has left it."""
    goal = PAINT.goal.encode(request)
    goal_id = id_of(number)
    fields.setdefault("stamp", number)
    return StoredGoal(goal_id, sender=UNKNOWN_SENDER, digest=digest_of(goal), goal=goal, **fields)


def store_with(*goals: StoredGoal) -> MemoryStore:
    store = MemoryStore()
    store.goals = {("paint", goal.goal_id): goal for goal in goals}
    return store
