"""The log records of a goal's executor, which a server keeps for clients if it is asked to."""

from __future__ import annotations

import logging
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from fibaction import Action, ActionClient, ActionServer, GoalAborted, GoalHandle, GoalID
from fibaction.server import log_keeper
from fibaction.server.log_keeper import LogKeeper
from fibaction.words.goals import CurrentGoal, current_goal

pytestmark = pytest.mark.anyio

GRIP = Action("grip", goal=int, feedback=str, result=int)
log = logging.getLogger("arm.gripper")


async def grip(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
    """Log the number of the goal, also in a thread."""
    log.warning("grips %d", goal.request)
    await anyio.to_thread.run_sync(log.warning, "measures %d", goal.request)
    log.debug("this level is not enabled")
    try:
        raise ValueError("too hot")
    except ValueError:
        log.exception("cannot hold")
    yield goal.request


@asynccontextmanager
async def gripping(**settings: Any) -> AsyncGenerator[ActionServer[int, str, int], None]:
    with anyio.fail_after(30):
        async with ActionServer(GRIP, grip, **settings) as server:
            yield server


async def done(server: ActionServer[int, str, int], number: int) -> GoalID:
    goal = await ActionClient(server, GRIP).send_goal(number)
    await goal.outcome()
    return goal.goal_id


async def lines_of(server: ActionServer[int, str, int], goal_id: GoalID) -> list[str]:
    lines = await server.log_lines(goal_id)
    assert lines is not None
    return [line.text for line in lines]


async def test_the_lines_of_each_goal_are_its_own() -> None:
    async with gripping(log_lines=100) as server:
        goals = [await done(server, number) for number in (1, 2)]
        log.warning("not logged by an executor")
        first, second = [await lines_of(server, one) for one in goals]
        lines = await server.log_lines(goals[0])
        assert await server.log_lines(GoalID.random()) == []
    assert first[:2] == ["grips 1", "measures 1"]
    assert second[:2] == ["grips 2", "measures 2"]
    assert lines is not None
    kinds = [(line.level, line.logger) for line in lines]
    assert kinds == [("WARNING", "arm.gripper")] * 2 + [("ERROR", "arm.gripper")]
    assert lines[0].at <= lines[1].at
    assert first[2].startswith("cannot hold\n")
    assert first[2].endswith("ValueError: too hot")


async def test_only_the_newest_lines_of_a_goal_are_kept() -> None:
    async with gripping(log_lines=2) as server:
        kept = await lines_of(server, await done(server, 1))
    assert kept[0] == "measures 1"
    assert len(kept) == 2


async def test_a_server_keeps_no_lines_unless_it_is_asked_to() -> None:
    handlers = list(logging.getLogger().handlers)
    async with gripping() as server:
        assert logging.getLogger().handlers == handlers
        assert await server.log_lines(await done(server, 1)) is None
    async with gripping(log_lines=1):
        assert len(logging.getLogger().handlers) == len(handlers) + 1
    assert logging.getLogger().handlers == handlers


@pytest.mark.parametrize("most", [-1, 1001, "many"])
def test_the_number_of_lines_is_checked(most: Any) -> None:
    with pytest.raises((TypeError, ValueError), match="log_lines must be"):
        ActionServer(GRIP, grip, log_lines=most)


@pytest.fixture
def keeper() -> LogKeeper:
    return LogKeeper("grip", 3)


def tell(keeper: LogKeeper, goal_id: GoalID, text: str, *values: Any, action: str = "grip") -> None:
    """Log a record, as an executor of that goal does."""
    token = current_goal.set(CurrentGoal(action, goal_id))
    try:
        keeper.handle(logging.LogRecord("arm", logging.INFO, "", 0, text, values, None))
    finally:
        current_goal.reset(token)


def test_goals_of_which_nothing_was_logged_for_the_longest_time_leave(
    keeper: LogKeeper, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_keeper, "MOST_GOALS", 2)
    one, two, three = [GoalID.random() for _ in range(3)]
    for goal_id in (one, two, one, three):
        tell(keeper, goal_id, "moves")
    assert [len(keeper.of(goal_id) or ()) for goal_id in (one, two, three)] == [2, 0, 1]


def test_the_characters_of_all_lines_are_bounded(
    keeper: LogKeeper, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_keeper, "MOST_LETTERS", 25)
    one, two = GoalID.random(), GoalID.random()
    for _ in range(4):  # of which three are kept
        tell(keeper, one, "123456")
    tell(keeper, two, "1234567")
    assert [len(keeper.of(goal_id) or ()) for goal_id in (one, two)] == [3, 1]
    tell(keeper, two, "1")
    assert [len(keeper.of(goal_id) or ()) for goal_id in (one, two)] == [0, 2]


def test_the_number_of_all_lines_is_bounded_also_if_they_are_empty(
    keeper: LogKeeper, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_keeper, "MOST_LINES", 4)
    goals = [GoalID.random() for _ in range(3)]
    for goal_id in (*goals[:1] * 4, *goals[1:]):  # of one goal, three lines are kept
        tell(keeper, goal_id, "")
    assert [len(keeper.of(goal_id) or ()) for goal_id in goals] == [0, 1, 1]


def test_a_long_line_is_cut(keeper: LogKeeper) -> None:
    tell(keeper, goal_id := GoalID.random(), "x" * 5000)
    [line] = keeper.of(goal_id) or []
    assert line.text == "x" * 999 + "…"


def test_a_record_of_another_action_or_with_wrong_arguments_is_not_kept(
    keeper: LogKeeper, capsys: pytest.CaptureFixture[str]
) -> None:
    goal_id = GoalID.random()
    tell(keeper, goal_id, "moves", action="drive")
    tell(keeper, goal_id, "moves %d times", "many")
    assert keeper.of(goal_id) == []
    assert "--- Logging error ---" in capsys.readouterr().err


async def test_why_an_executor_has_failed_is_among_the_lines_of_its_goal() -> None:
    async def fail(goal: GoalHandle[int]) -> AsyncGenerator[int | str, None]:
        yield "grips"
        raise KeyError("no such gripper")

    async with ActionServer(GRIP, fail, log_lines=10) as server:
        goal = await ActionClient(server, GRIP).send_goal(1)
        with pytest.raises(GoalAborted):
            await goal.result()
        [line] = await server.log_lines(goal.goal_id) or []
    assert "no such gripper" in line.text


async def test_records_that_nothing_else_handles_are_still_written_to_stderr_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    own = logging.getLogger("arm.with_handler")
    monkeypatch.setattr(own, "handlers", [logging.NullHandler()])
    async with gripping(log_lines=2), gripping(log_lines=2):
        log.warning("nobody has set up logging")
        log.info("not so important")
        own.warning("goes to its own handler")
        other = logging.NullHandler()
        logging.getLogger().addHandler(other)
        log.warning("goes to the handler of the program")
        logging.getLogger().removeHandler(other)
        monkeypatch.setattr(logging, "lastResort", None)
        log.warning("is not to be written")
    assert capsys.readouterr().err == "nobody has set up logging\n"
