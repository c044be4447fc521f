"""The servers that the JavaScript client is tested against: `fibaction serve` runs them."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextvars import ContextVar
from typing import Any

import anyio
import msgspec

from fibaction import (
    Action,
    ActionServer,
    CancelRejected,
    GoalAborted,
    GoalHandle,
    GoalID,
    GoalRejected,
    Sender,
    Watcher,
)
from fibaction.border.abc import Meta


class Count(msgspec.Struct):
    """How far to count, with a pause after each of the first numbers, and what to do then."""

    to: int
    pause: float = 0.0
    pauses: int = 1_000_000
    then: str = "succeed"


class Counted(msgspec.Struct):
    """The last number, the attempt, and a number beyond those of JavaScript."""

    to: int
    attempt: int
    large: int = 2**63 - 1


COUNT = Action("arm/count", goal=Count, feedback=int, result=Counted)
LATEST = Action("latest", goal=Count, feedback=int, result=Counted)

TRACE: ContextVar[str] = ContextVar("TRACE", default="none")

Items = AsyncGenerator[int | Counted, None]


class Tracer(Watcher):
    """A watcher that gives the trace of a goal to its executor."""

    def offered(
        self, action: str, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta
    ) -> None:
        """Set the variable that the executor sees."""
        TRACE.set(meta.get("traceparent", "none"))


async def count(goal: GoalHandle[Count]) -> Items:
    """Count, and end as the goal says; `wait` never ends by itself."""
    request = goal.request
    for number in range(1, request.to + 1):
        if number <= request.pauses:
            await anyio.sleep(request.pause)
        yield number
    if request.then == "wait":
        await anyio.sleep_forever()
    result = Counted(request.to, goal.attempt)
    if request.then == "abort":
        raise GoalAborted("the arm is stuck", result=result)
    if request.then == "trace":
        raise GoalAborted(TRACE.get())
    yield result


def check(goal: Count) -> None:
    """Reject a negative number."""
    if goal.to < 0:
        raise GoalRejected("it is negative")


def keep_on(goal: GoalHandle[Count]) -> None:
    """Reject the cancel of goals that count to 13."""
    if goal.request.to == 13:
        raise CancelRejected("13 must not stop")


def servers() -> list[ActionServer[Any, Any, Any]]:
    """Return the servers."""
    return [
        ActionServer(
            COUNT,
            count,
            on_goal=check,
            on_cancel=keep_on,
            recovery="rerun",
            watchers=[Tracer()],
        ),
        ActionServer(LATEST, count, feedback="latest", recovery="rerun"),
    ]
