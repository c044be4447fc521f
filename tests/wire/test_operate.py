"""An operator's change over the wire: permissions, names, and servers of an earlier version."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Any

import pytest

from fibaction import (
    ActionServer,
    AuthenticationFailed,
    GoalID,
    Peer,
    Permission,
    ServerNotFound,
    TransportError,
    __version__,
    connect,
    serve,
)
from fibaction.border.abc import ForwardingEndpoint
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


class Again(ForwardingEndpoint):
    """A server that runs one goal again, once."""

    async def rerun(self, goal_id: GoalID) -> GoalID | None:
        return GOAL_ID if goal_id == OLD_ID else None


@pytest.fixture
async def server() -> AsyncGenerator[Any, None]:
    async with ActionServer(FIBONACCI, fibonacci) as running:
        yield running


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


async def test_only_a_client_that_may_operate_changes_anything(server: Any) -> None:
    def authorize(_peer: Peer, _action: str, permission: Permission) -> bool:
        return permission is not Permission.OPERATE

    async with serve(server, TCP, authorize=authorize) as (url,):
        async with connect(url, FIBONACCI) as client:
            with pytest.raises(AuthenticationFailed, match="may not operate"):
                await client.endpoint.change_intake(PAUSE)
            with pytest.raises(AuthenticationFailed, match="may not operate"):
                await client.endpoint.rerun(OLD_ID)
            intake = await client.endpoint.intake()
            assert (intake.mode, intake.changes) == (IntakeMode.OPEN, ())


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


async def test_a_goal_that_was_given_up_runs_again_as_another_one(server: Any) -> None:
    async with serve(Again(server), TCP) as (url,), connect(url, FIBONACCI) as client:
        assert await client.endpoint.rerun(OLD_ID) == GOAL_ID
        assert await client.endpoint.rerun(GOAL_ID) is None


async def test_a_server_of_an_earlier_version_is_not_asked(
    server: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "NEWEST_FROM_CLIENT", 27)
    async with serve(server, TCP) as (url,), connect(url, FIBONACCI) as client:
        assert await client.endpoint.intake() is FIXED_INTAKE
        with pytest.raises(TransportError, match="earlier version"):
            await client.endpoint.change_intake(PAUSE)
        with pytest.raises(TransportError, match="earlier version, and runs no goal again"):
            await client.endpoint.rerun(OLD_ID)


async def test_before_the_first_connection_nothing_is_changed() -> None:
    calls = OpenCalls(9, 9)
    assert await calls.operate("drive") is OPEN_INTAKE
    with pytest.raises(ServerNotFound, match="has not answered yet"):
        await calls.operate("drive", PAUSE)


async def test_a_client_of_a_session_may_observe_what_the_server_permits() -> None:
    settings = WireSettings(authorize=lambda peer, action, permission: action == "drive")
    client = SessionClient("127.0.0.1:51234", {}, settings)
    client.greet(Hello(VERSION, 1.0))
    assert [await client.may_observe(action) for action in ("drive", "lift")] == [True, False]
