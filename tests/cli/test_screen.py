"""The screen of `top`, driven by keys, and what is on it at 80 and at 160 columns."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from textual.pilot import Pilot
from textual.widgets import DataTable

from fibaction import (
    Action,
    ActionInfo,
    CancelAnswer,
    CancelCode,
    ConnectionLost,
    GoalID,
    GoalInfo,
    Outcome,
)
from fibaction.border.abc import Endpoint
from fibaction.cli.output import screen
from fibaction.cli.output.escape import clean
from fibaction.cli.output.screen import TopScreen
from fibaction.cli.output.screen_tables import FeedbackText
from fibaction.client.events import GoalFeedback
from fibaction.observe.monitor import GoalKey, Monitor
from fibaction.words.statuses import GoalStatus
from tests.cli.served import Altered, Served, counter
from tests.support.processes import PATIENCE

FIRST, SECOND = GoalID(b"\x11" * 16), GoalID(b"\x22" * 16)


def filled() -> Monitor:
    """A monitor with two actions, and two goals of the first."""
    server = counter("arm/pick")
    monitor = Monitor(summarize=FeedbackText.of)
    pick = ActionInfo("arm/pick", "arm/action/Pick")
    monitor.on_actions([pick, ActionInfo("wait")], "")
    monitor.on_action_found(pick, Served(server).connection.client(server.action))
    monitor.on_action_lost("wait", "its server has stopped")
    monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.EXECUTING, 0, "lab at 1.2.3.4:5"))
    monitor.on_event("arm/pick", GoalInfo(SECOND, 1, GoalStatus.EXECUTING, 0, "me"))
    monitor.on_event("arm/pick", GoalFeedback(FIRST, 41, {"progress": 0.5, "step": "reach " * 30}))
    return monitor


@asynccontextmanager
async def shown(monitor: Monitor, columns: int = 80) -> AsyncGenerator[Pilot[None], None]:
    app = TopScreen(monitor, "tcp://robot:7400")
    async with app.run_test(size=(columns, 24), notifications=True) as pilot:
        with anyio.fail_after(PATIENCE):
            while "q Quit" not in lines(pilot)[-1]:  # the keys come last, a moment later
                await pilot.pause()
        yield pilot


def lines(pilot: Pilot[None]) -> list[str]:
    """What is on the screen."""
    width, height = pilot.app.size
    strips = pilot.app.screen._compositor.render_strips()
    assert len(strips) == height
    texts = [strip.text for strip in strips]
    assert all(len(text) == width for text in texts)
    return [text.rstrip() for text in texts]


async def press(pilot: Pilot[None], *keys: str) -> None:
    """Press keys, and wait until the screen has handled them."""
    await pilot.press(*keys)
    await pilot.pause()


async def until(pilot: Pilot[None], text: str) -> None:
    """Wait until the text is on the screen."""
    with anyio.fail_after(PATIENCE):
        while not any(text in line for line in lines(pilot)):
            await pilot.pause()


def watching(server: Endpoint) -> Monitor:
    """A monitor that has found the action of a server."""
    monitor = Monitor(summarize=FeedbackText.of)
    client = Served(server).connection.client(Action.untyped(server.info))
    monitor.on_action_found(server.info, client)
    return monitor


def find(pilot: Pilot[None], text: str) -> str:
    """The line that has the text."""
    return next(line for line in lines(pilot) if text in line)


@pytest.mark.asyncio
@pytest.mark.parametrize("columns", [80, 160])
async def test_everything_fits_the_width(columns: int) -> None:
    async with shown(filled(), columns) as pilot:
        state, heads = lines(pilot)[:2]
        goals = find(pilot, "LATEST")
        first = find(pilot, "11111111").split()
        assert state == " tcp://robot:7400  2 active, 0 ended, 0.0 feedback/s  newest first"
        assert heads.split() == ["ACTION", "ACTIVE", "ENDED", "FEEDBACK/S", "TYPE"]
        assert find(pilot, "arm/action/Pick").split()[:2] == ["/arm/pick", "2"]
        assert "away: its server has stopped" in find(pilot, " /wait")
        assert first[1:3] == ["/arm/pick", "EXECUTING"]
        assert "41" in first
        assert first[-1].endswith("…"), "what does not fit is seen to be cut"
        assert ("CLIENT" in goals) == ("1.2.3.4:5" in " ".join(first)) == (columns == 160)
        assert "c Cancel goal  f Follow goal  / Filter  s Sort  q Quit" in lines(pilot)[-1]
        for name in ("#actions", "#goals"):
            assert pilot.app.query_one(name).max_scroll_x == 0


@pytest.mark.asyncio
@pytest.mark.parametrize("key", ["f", "enter"])
async def test_a_goal_is_followed_until_it_is_no_more(key: str) -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        await press(pilot, key)
        assert find(pilot, f"/arm/pick {FIRST} EXECUTING")
        assert find(pilot, "progress: 0.5")
        monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.UNKNOWN))
        pilot.app.query_one(DataTable)
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.pause()
        assert find(pilot, f"{FIRST} forgotten by the server")
        await press(pilot, "escape")
        assert not [line for line in lines(pilot) if "progress: 0.5" in line]
        await press(pilot, key)
        assert find(pilot, "No feedback has come while this screen was open.")
        await press(pilot, key)
        assert not [line for line in lines(pilot) if "No feedback has come" in line]


@pytest.mark.asyncio
@pytest.mark.parametrize("name", ["[red]pick", "[/pick]", "[@click=app.quit]pick[/]", "pick\x1b"])
async def test_an_action_may_have_any_name(name: str) -> None:
    monitor = watching(counter("pick"))
    monitor.on_action_found(ActionInfo(name), monitor._client(GoalKey("pick", FIRST)))
    monitor.on_event(name, GoalInfo(FIRST, 2, GoalStatus.EXECUTING))
    async with shown(monitor) as pilot:
        await press(pilot, "f")
        assert find(pilot, f"/{clean(name)} {FIRST} EXECUTING")


@pytest.mark.asyncio
async def test_the_cursor_stays_at_its_goal() -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        await pilot.press("down")
        screen = pilot.app
        assert isinstance(screen, TopScreen)
        assert screen._selected() == GoalKey("arm/pick", SECOND)
        monitor.on_event("arm/pick", GoalInfo(GoalID(b"\x33" * 16), 3, GoalStatus.ACCEPTED))
        screen.draw()
        await pilot.pause()
        assert screen._selected() == GoalKey("arm/pick", SECOND)
        assert screen.query_one("#goals", DataTable).cursor_row == 2
        await pilot.resize_terminal(160, 40)
        assert screen._selected() == GoalKey("arm/pick", SECOND)


@pytest.mark.asyncio
async def test_the_goal_under_the_cursor_is_canceled() -> None:
    server = counter("arm/pick")
    monitor = watching(server)
    async with server, shown(monitor) as pilot:
        await pilot.press("c", "f")  # there is none
        goal = await Served(server).connection.client(server.action).send_goal(1, goal_id=FIRST)
        monitor.on_event("arm/pick", GoalInfo(FIRST, 1, GoalStatus.EXECUTING))
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.press("c", "y")
        await pilot.app.workers.wait_for_complete()
        assert (await goal.outcome()).status is GoalStatus.CANCELED
        await pilot.pause()
        assert find(pilot, "Canceling the goal 11111111")


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("error", "text"),
    [(None, "is not canceled: never"), (ConnectionLost("the line is dead"), "the line is dead")],
)
async def test_what_is_not_canceled_is_told_of(error: ConnectionLost | None, text: str) -> None:
    async def cancel(*_: object) -> CancelAnswer:
        if error is not None:
            raise error
        return CancelAnswer(CancelCode.REJECTED, reason="never")

    server = counter("arm/pick")
    altered = Altered(server, cancel_goals=cancel)
    monitor = watching(altered)
    monitor.on_event("arm/pick", GoalInfo(FIRST, 1, GoalStatus.EXECUTING))
    async with shown(monitor, 160) as pilot:
        await pilot.press("c", "y")
        await pilot.app.workers.wait_for_complete()
        await pilot.pause()
        assert find(pilot, text)


@pytest.mark.asyncio
@pytest.mark.parametrize("key", ["n", "escape"])
async def test_a_goal_is_left_when_the_question_is_answered_with_no(key: str) -> None:
    async with shown(filled()) as pilot:
        await press(pilot, "c")
        assert find(pilot, "Cancel the goal 11111111 of /arm/pick?")
        with anyio.fail_after(PATIENCE):
            while "y Yes, cancel it  n No  q Quit" not in lines(pilot)[-1]:
                await pilot.pause()
        await press(pilot, "f", key, "y")  # neither follows nor cancels
        assert not [line for line in lines(pilot) if "Cancel the goal" in line]
        assert not pilot.app.query_one("#followed").display
        assert not pilot.app.workers


@pytest.mark.asyncio
async def test_goals_are_filtered_while_the_words_are_typed() -> None:
    async with shown(filled(), 160) as pilot:
        await press(pilot, "slash", *"q2222")
        assert "0 of 2 with “q2222”" in lines(pilot)[0]
        await press(pilot, "home", "delete", "enter")
        assert "1 of 2 with “2222”" in lines(pilot)[0]
        assert find(pilot, "22222222")
        assert not [line for line in lines(pilot) if "11111111" in line]
        assert not pilot.app.query_one("#filter").display
        await press(pilot, "escape")
        assert "with" not in lines(pilot)[0]
        assert find(pilot, "11111111")


@pytest.mark.asyncio
async def test_goals_are_sorted_in_the_next_order() -> None:
    async with shown(filled()) as pilot:
        await press(pilot, "s")
        assert lines(pilot)[0].endswith("  oldest first")
        ids = [line.split()[0] for line in lines(pilot) if "EXECUTING" in line]
        assert ids == ["22222222", "11111111"]


@pytest.mark.asyncio
async def test_a_server_that_is_away_is_shown_at_the_top() -> None:
    monitor = filled()
    async with shown(monitor) as pilot:
        monitor.on_actions(None, "it does not answer\x1b")
        assert isinstance(pilot.app, TopScreen)
        pilot.app.draw()
        await pilot.pause()
        assert lines(pilot)[0].startswith(
            " tcp://robot:7400  the server is away: it does not answer\\x1b"
        )
        assert pilot.app.query_one("#state").has_class("away")


@pytest.mark.asyncio
async def test_a_screen_that_is_being_taken_down_is_drawn_no_more() -> None:
    async with shown(filled()) as pilot:
        assert isinstance(pilot.app, TopScreen)
        await pilot.app.query_one("#state").remove()
        pilot.app.draw()


@pytest.mark.asyncio
async def test_some_of_many_actions_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screen, "MOST_SHOWN", 2)
    monitor = filled()
    monitor.on_actions([ActionInfo(f"name{number}") for number in range(1000)], "")
    async with shown(monitor) as pilot:
        assert pilot.app.query_one("#actions", DataTable).row_count == 2
        find(pilot, "/arm/pick")  # it has active goals


@pytest.mark.asyncio
async def test_a_goal_that_has_ended_is_shown_with_its_reason_and_result() -> None:
    class Answering(Monitor):
        asked = 0

        async def outcome(self, key: GoalKey) -> Outcome[Any]:
            self.asked += 1
            return Outcome(GoalStatus.ABORTED, {"meters": 2}, "stuck")

    monitor = Answering(summarize=FeedbackText.of)
    monitor.on_actions([ActionInfo("arm/pick")], "")
    monitor.on_event("arm/pick", GoalInfo(FIRST, 2, GoalStatus.ABORTED))
    async with shown(monitor) as pilot:
        await pilot.press("f")
        await until(pilot, "  meters: 2")
        assert find(pilot, "Reason: stuck")
        assert find(pilot, "No feedback has come")
        assert monitor.asked == 1
