"""`fibaction.observe.log_records`: the goal of each record, also of two executors at once."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncGenerator
from datetime import UTC, datetime

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalHandle, Schedule
from fibaction.observe.log_records import GoalFilter, JsonFormatter

COUNT = Action("count", goal=int, feedback=int, result=str)

pytestmark = pytest.mark.anyio


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str, str]]:
    """Return a list that gets the message, the goal and the action of each record of this test."""
    found: list[tuple[str, str, str]] = []

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            fields = json.loads(JsonFormatter().format(record))
            found.append((fields["message"], fields.get("goal_id", ""), fields.get("action", "")))

    handler = Handler()
    handler.addFilter(GoalFilter())
    caplog.set_level(logging.INFO, logger="robot")
    logger = logging.getLogger("robot")
    logger.handlers[:] = [handler]
    return found


def move(number: int) -> None:
    logging.getLogger("robot").info("%d moves", number)


async def test_each_line_of_two_executors_at_once_has_its_own_goal_and_others_have_none(
    lines: list[tuple[str, str, str]],
) -> None:
    async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        move(goal.request)
        yield 1
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(anyio.to_thread.run_sync, move, goal.request)
        move(goal.request)
        yield "done"

    async with ActionServer(COUNT, count) as server:
        client = ActionClient(server, COUNT)
        goals = [await client.send_goal(number) for number in (1, 2)]
        for goal in goals:
            await goal.outcome()
        move(3)

    for number, goal in enumerate(goals, 1):
        of_it = [line for line in lines if line[0] == f"{number} moves"]
        assert of_it == [(f"{number} moves", str(goal.goal_id), "count")] * 3
    assert lines[-1] == ("3 moves", "", "")


async def test_an_executor_that_takes_its_successor_over_logs_the_new_goal(
    lines: list[tuple[str, str, str]],
) -> None:
    async def count(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        move(goal.request)
        await goal.wait_for_successor()
        goal = goal.take_over()
        move(goal.request)
        yield "done"

    schedule = Schedule(concurrency=1, when_full="preempt", handover=5)
    async with ActionServer(COUNT, count, schedule=schedule) as server:
        client = ActionClient(server, COUNT)
        goals = [await client.send_goal(number) for number in (1, 2)]
        await goals[1].outcome()

    assert [goal_id for _, goal_id, _ in lines] == [str(goal.goal_id) for goal in goals]


def test_a_json_line_has_the_time_the_level_the_logger_and_the_traceback() -> None:
    error = ValueError("stuck\x1b[2J")
    record = logging.makeLogRecord(
        {
            "name": "robot",
            "levelname": "ERROR",
            "msg": "arm %s\n",
            "args": ("é",),
            "created": 0.5,
            "exc_info": (ValueError, error, None),
        }
    )

    line = JsonFormatter().format(record)

    assert line.isascii()
    assert json.loads(line) == {
        "time": datetime(1970, 1, 1, 0, 0, 0, 500_000, UTC).isoformat(timespec="milliseconds"),
        "level": "ERROR",
        "logger": "robot",
        "message": "arm é\n",
        "traceback": "  ValueError: stuck\\x1b[2J",
    }
