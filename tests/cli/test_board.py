"""What `top` shows, without a screen."""

from __future__ import annotations

from functools import partial
from typing import Any

import anyio
import pytest

from fibaction import ActionInfo, CancelCode, ConnectionLost, GoalID, GoalInfo, GoalStatus
from fibaction.cli import board as board_module
from fibaction.cli.board import Board, GoalKey, Rate
from fibaction.cli.goal_list import AnyClient
from fibaction.cli.observing import observe
from fibaction.events import GoalFeedback
from tests.cli.served import Heard, Served, counter

ID = GoalID(b"\x01" * 16)
OTHER = GoalID(b"\x02" * 16)
KEY = GoalKey("one", ID)
ONE = ActionInfo("one")


def info(status: int, *, goal_id: GoalID = ID, stamp: int = 1, count: int = 0) -> GoalInfo:
    return GoalInfo(goal_id, stamp, GoalStatus(status), count)


def feedback(number: int) -> GoalFeedback[int]:
    return GoalFeedback(ID, number, number * 10)


@pytest.fixture
def board() -> Board:
    """A board with an action, and with a clock that goes a second at each look."""
    seconds = iter(range(1000))
    board = Board(clock=lambda: next(seconds))
    board.reached([ONE], "")
    return board


def test_goals_come_change_and_are_forgotten(board: Board) -> None:
    board.told("one", info(1))
    board.told("one", info(2))
    assert board.goals[KEY].status is GoalStatus.EXECUTING
    board.told("one", info(0))
    board.told("one", info(0))

    assert not board.goals


def test_what_crosses_on_the_way_does_not_turn_back_time(board: Board) -> None:
    board.told("one", GoalInfo(ID, 1, GoalStatus.SUCCEEDED, 5, "me"))
    board.told("one", info(2, count=3))

    assert board.goals[KEY].row.info == GoalInfo(ID, 1, GoalStatus.SUCCEEDED, 5, "me")


def test_feedback_is_counted_by_its_numbers(board: Board) -> None:
    board.told("one", info(2))
    board.told("one", feedback(7))  # the first that was seen
    board.sample()
    for number in (8, 10, 12):
        board.told("one", feedback(number))
    board.sample()

    goal = board.goals[KEY]
    assert goal.row.info.feedback_count == 12
    assert goal.rate.per_second == board.actions["one"].rate.per_second == 5.0
    assert (goal.line, goal.text) == ("120", "120")
    board.told("one", GoalFeedback(OTHER, 1, 0))  # of a goal that nobody knows


def test_a_rate_is_that_of_the_last_seconds() -> None:
    rate = Rate()
    assert rate.per_second == 0
    rate.sample(0)
    rate.sample(0)
    assert rate.per_second == 0
    rate.count = 1000
    for second in range(1, 20):
        rate.sample(second)
    assert rate.per_second == 0
    rate.count += 10
    rate.sample(20)
    assert rate.per_second == pytest.approx(2.0)


def test_active_goals_come_first_then_the_newest(board: Board) -> None:
    for number, (status, stamp) in enumerate([(4, 5), (2, 1), (6, 9), (2, 3)]):
        board.told("one", info(status, goal_id=GoalID(bytes([number] * 16)), stamp=stamp))
    board.sample()

    assert [line.row.info.stamp for line in board.ordered(3)] == [3, 1, 9]
    assert (board.actions["one"].active, board.actions["one"].ended) == (2, 2)


def test_who_is_away_is_said_until_he_is_back(board: Board) -> None:
    client = Served(counter("one")).connection.client(counter("one").action)
    board.gone("one", "stopped")
    board.gone("unheard", "of")
    board.reached(None, "silent")
    assert (board.actions["one"].away, board.away) == ("stopped", "silent")
    board.found(ONE, client)
    board.reached([], "")

    assert (board.actions["one"].away, board.away) == ("", "")


class Loud(Board):
    """A board that says what it has heard and asked."""

    def __init__(self) -> None:
        super().__init__()
        self.heard = Heard()

    def found(self, info: ActionInfo, client: AnyClient) -> None:
        super().found(info, client)
        self.heard(info.name)

    def told(self, action: str, event: GoalInfo | GoalFeedback[Any]) -> None:
        super().told(action, event)
        self.heard(type(event).__name__)

    async def _ask(self, action: str, client: AnyClient) -> None:
        await super()._ask(action, client)
        self.heard("asked")


@pytest.mark.asyncio
async def test_it_follows_real_servers_and_asks_them_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board_module, "LOOK", 0.02)
    board, server = Loud(), counter("one")
    stale = GoalKey("one", OTHER)
    served = Served(server, counter("not_started"))
    async with server, anyio.create_task_group() as tasks:
        tasks.start_soon(partial(observe, served.connection, board, feedback=True))
        await board.heard.until(lambda all: "one" in all)
        await served.connection.client(server.action).send_goal(1, goal_id=ID)
        await board.heard.until(lambda all: "GoalFeedback" in all)
        board.told("one", info(2, goal_id=OTHER))  # of a server that was there before
        board.reached([ONE, ActionInfo("unfollowed")], "")
        tasks.start_soon(board.keep)
        await board.heard.until(lambda all: "asked" in all)
        answer = await board.cancel(KEY)
        tasks.cancel_scope.cancel()

    assert answer.return_code is CancelCode.NONE
    assert [line.key for line in board.ordered(9)] == [KEY]
    assert stale not in board.goals


@pytest.mark.asyncio
async def test_a_server_that_cannot_be_asked_keeps_its_goals(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board_module, "LOOK", 0.01)
    server = counter("one")
    asked = anyio.Event()

    async def lost(*_: object) -> None:
        asked.set()
        raise ConnectionLost("the line is dead")

    monkeypatch.setattr(server, "status", lost)
    board.found(ONE, Served(server).connection.client(server.action))
    board.told("one", info(2))
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(board.keep)
        with anyio.fail_after(5):
            await asked.wait()
            await anyio.wait_all_tasks_blocked()
        tasks.cancel_scope.cancel()

    assert KEY in board.goals
