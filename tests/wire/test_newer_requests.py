"""Requests that servers of earlier versions do not know: an operator's, and for a log."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import pytest

from fibaction import (
    ActionServer,
    GoalID,
    ServerNotFound,
    TransportError,
    __version__,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint, LogLine
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.messages import VERSION, Hello
from fibaction.wire.server import session
from fibaction.wire.server.session_client import SessionClient
from fibaction.wire.settings import WireSettings
from fibaction.words.intake import FIXED_INTAKE, OPEN_INTAKE, Intake, IntakeChange, IntakeMode
from tests.support.fibonacci import FIBONACCI, fibonacci

pytestmark = pytest.mark.anyio

TCP = "tcp://127.0.0.1:0"
OLD_ID, GOAL_ID = GoalID.random(), GoalID.random()
PAUSE = IntakeChange(IntakeMode.HOLD, "wet floor", "ann")
LINES = [LogLine(1, "INFO", "arm", "grips"), LogLine(2, "ERROR", "arm", "is stuck")]


class Remembering(ForwardingEndpoint):
    """A server that runs one goal again, and has the log of it, and no other ones."""

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return GOAL_ID if goal_id == OLD_ID else None

    async def log_lines(self, goal_id: GoalID) -> list[LogLine] | None:
        return {OLD_ID: LINES, GOAL_ID: []}.get(goal_id)


@pytest.fixture
async def server() -> AsyncGenerator[Any, None]:
    async with ActionServer(FIBONACCI, fibonacci) as running:
        yield Remembering(running)


async def test_a_change_has_the_name_of_the_client_and_that_which_it_gives_itself(
    server: Any,
) -> None:
    async with serve(server, TCP, tokens={"secret": "console"}) as (url,):
        async with connect(f"{url}?token=secret", FIBONACCI) as client:
            intake = await client.endpoint.change_intake(PAUSE)
            assert intake == await server.intake() == await client.endpoint.intake()
    [change] = intake.changes
    assert change.by.startswith("console at 127.0.0.1:")
    assert change.by.endswith(", for ann")


async def test_a_client_learns_the_version_the_schedule_and_whether_there_are_levers(
    server: Any,
) -> None:
    class Fixed(ForwardingEndpoint):
        async def intake(self) -> Intake:
            return FIXED_INTAKE

    async with serve(server, TCP) as (url,), serve(Fixed(server), TCP) as (other,):
        async with connect(url) as connection, connect(other, FIBONACCI) as client:
            intake = await connection.client(FIBONACCI).endpoint.intake()
            assert connection.release == __version__
            assert intake == await server.intake()
            assert intake.schedule is not None
            assert await client.endpoint.intake() == FIXED_INTAKE
        kept = await connect(url)
        await kept.actions()
        assert kept.release == __version__
        await kept.aclose()


async def test_a_goal_runs_again_as_another_one_and_its_log_is_told(server: Any) -> None:
    async with serve(server, TCP) as (url,), connect(url, FIBONACCI) as client:
        assert [await client.endpoint.rerun(one) for one in (OLD_ID, GOAL_ID)] == [GOAL_ID, None]
        asked = (OLD_ID, GOAL_ID, GoalID.random())
        assert [await client.endpoint.log_lines(one) for one in asked] == [LINES, [], None]


async def test_a_server_of_an_earlier_version_is_not_asked(
    server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "NEWEST_FROM_CLIENT", 27)
    async with serve(server, TCP) as (url,), connect(url, FIBONACCI) as client:
        assert await client.endpoint.intake() is FIXED_INTAKE
        assert await client.endpoint.log_lines(OLD_ID) is None
        with pytest.raises(TransportError, match="earlier version"):
            await client.endpoint.change_intake(PAUSE)
        with pytest.raises(TransportError, match="earlier version, and runs no goal again"):
            await client.endpoint.rerun(OLD_ID)


async def test_before_the_first_connection_nothing_is_known() -> None:
    calls = OpenCalls(9, 9)
    assert await calls.operate("drive") is OPEN_INTAKE
    assert await calls.log_lines("drive", GOAL_ID) is None
    with pytest.raises(ServerNotFound, match="has not answered yet"):
        await calls.operate("drive", PAUSE)


async def test_a_client_of_a_session_may_observe_what_the_server_permits() -> None:
    settings = WireSettings(authorize=lambda peer, action, permission: action == "drive")
    client = SessionClient("127.0.0.1:51234", {}, settings)
    client.greet(Hello(VERSION, 1.0))
    assert [await client.may_observe(action) for action in ("drive", "lift")] == [True, False]
