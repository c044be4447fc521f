"""`fibaction.wire.ownership`: a real server's goals, whose clients come and go."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any, Literal

import anyio
import pytest

from fibaction._tasks import Background
from fibaction.abc import GoalStream
from fibaction.exceptions import ConnectionLost, GoalRejected
from fibaction.goals import CancelAnswer, GoalID
from fibaction.server.registry import ID_IN_USE
from fibaction.states import GoalStatus
from fibaction.testing import ScriptedServer
from fibaction.wire.ownership import Owners
from tests.fibonacci import FIBONACCI, Feedback, Goal, Result
from tests.virtual_time import in_virtual_time
from tests.wire.memory import logged, settled

pytestmark = pytest.mark.anyio

GRACE = 10.0
ANN, BOB = b"ann", b"bob"


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


class Server(ScriptedServer[Goal, Feedback, Result]):
    """Its goals wait for `go`, and then succeed; a cancel may go wrong."""

    def __init__(self, cancel_error: Exception | None = None) -> None:
        self.go = anyio.Event()
        self.canceled: list[GoalID | None] = []
        self._cancel_error = cancel_error
        super().__init__(FIBONACCI, [self.go, Result([1])])

    async def cancel_goals(
        self, goal_id: GoalID | None = None, stamp: int | None = None
    ) -> CancelAnswer:
        self.canceled.append(goal_id)
        if self._cancel_error is not None:
            raise self._cancel_error
        return await super().cancel_goals(goal_id, stamp)

    async def goal(self) -> GoalStream:
        stream = await self.send_goal(GoalID.random(), FIBONACCI.goal.encode(Goal(1)))
        await told(stream)
        return stream


@asynccontextmanager
async def nursery(
    then: Literal["keep", "cancel"], server: Server | None = None
) -> AsyncGenerator[tuple[Owners, Server], None]:
    server = server or Server()
    async with server, Background() as tasks:
        yield Owners(tasks, grace=GRACE, then=then), server


def is_closed(stream: GoalStream) -> bool:
    """Whether the stream was closed, so that it cannot make the executor wait."""
    return not stream.reads


async def owned_twice(orphans: Owners, server: Server) -> tuple[GoalStream, GoalStream]:
    """A goal that its client follows by one stream, and then by another."""
    stream = await server.goal()
    orphans.own(stream, ANN)
    again = await server.feedback(stream.goal_id, own=True)
    orphans.own(again, ANN)
    return stream, again


def lose(orphans: Owners, server: Server, stream: GoalStream, *, left: bool) -> None:
    """A client has the goal, and its connection is lost."""
    orphans.own(stream, ANN)
    orphans.adopt(server, stream, left=left)


async def told(stream: GoalStream) -> None:
    """Take the status that every goal has first."""
    with anyio.fail_after(5):
        assert await anext(aiter(stream)) is GoalStatus.EXECUTING


@in_virtual_time()
async def test_a_goal_that_is_kept_is_let_go_after_the_grace_and_runs_on() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        lose(orphans, server, stream, left=False)
        await anyio.sleep(GRACE - 0.1)
        assert not is_closed(stream)
        await anyio.sleep(0.2)
        assert is_closed(stream)
        assert server.canceled == []
        server.go.set()
        with anyio.fail_after(5):
            assert (await stream.outcome()).status is GoalStatus.SUCCEEDED


@in_virtual_time()
async def test_a_goal_that_is_not_kept_is_canceled_after_the_grace() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        with logged() as lines:
            lose(orphans, server, stream, left=False)
            await anyio.sleep(GRACE - 0.1)
            assert stream.status is GoalStatus.EXECUTING
            await anyio.sleep(0.2)
        with anyio.fail_after(5):
            assert (await stream.outcome()).status is GoalStatus.CANCELED
        assert [line.getMessage() for line in lines] == [
            f"goal {stream.goal_id} is canceled: its client has not come back"
        ]


@in_virtual_time()
async def test_a_goal_that_has_ended_by_then_is_not_canceled() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        lose(orphans, server, stream, left=False)
        server.go.set()
        await anyio.sleep(2 * GRACE)
        assert server.canceled == []
        assert (await stream.outcome()).status is GoalStatus.SUCCEEDED


async def test_the_goal_of_a_client_that_said_goodbye_is_let_go_at_once() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        lose(orphans, server, stream, left=True)
        assert is_closed(stream)
        assert server.canceled == []


async def test_the_goal_of_a_client_that_said_goodbye_is_canceled_at_once() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        lose(orphans, server, stream, left=True)
        with anyio.fail_after(5):
            assert (await stream.outcome()).status is GoalStatus.CANCELED


@in_virtual_time()
async def test_a_goal_whose_client_is_here_again_is_left_to_it() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        lose(orphans, server, stream, left=False)
        again = await server.feedback(stream.goal_id, own=True)
        orphans.own(again, ANN)
        assert is_closed(stream)
        await anyio.sleep(2 * GRACE)
        assert not is_closed(again)
        assert server.canceled == []


@in_virtual_time()
async def test_nobody_waits_for_a_client_that_is_here_again() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        await settled()
        tasks_before = len(anyio.get_running_tasks())
        for _ in range(3):
            lose(orphans, server, stream, left=False)
            await settled()
            assert len(anyio.get_running_tasks()) == tasks_before + 1
            orphans.own(stream, ANN)
            await settled()
            assert len(anyio.get_running_tasks()) == tasks_before


@in_virtual_time()
async def test_a_loss_that_is_noticed_when_the_client_is_here_again_does_nothing() -> None:
    async with nursery("cancel") as (orphans, server):
        stream, again = await owned_twice(orphans, server)
        orphans.adopt(server, stream, left=False)
        assert is_closed(stream)
        await anyio.sleep(2 * GRACE)
        assert not is_closed(again)
        assert server.canceled == []


@in_virtual_time()
async def test_a_goal_whose_end_was_told_is_no_orphan() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        orphans.own(stream, ANN)
        orphans.end(stream)
        assert is_closed(stream)
        orphans.adopt(server, stream, left=False)
        await anyio.sleep(2 * GRACE)
        assert server.canceled == []


@in_virtual_time()
async def test_of_two_calls_of_one_connection_both_go_on_and_the_last_is_kept() -> None:
    async with nursery("cancel") as (orphans, server):
        stream, again = await owned_twice(orphans, server)
        assert not is_closed(stream)
        for lost in (stream, again):
            orphans.adopt(server, lost, left=False)
        assert is_closed(stream)
        await anyio.sleep(GRACE - 1)
        assert not is_closed(again)
        third = await server.feedback(stream.goal_id, own=True)
        orphans.own(third, ANN)
        assert is_closed(again)
        fourth = await server.feedback(stream.goal_id, own=True)
        orphans.own(fourth, ANN)
        assert not is_closed(third)


async def test_the_end_of_a_stream_before_leaves_the_goal_to_the_one_after() -> None:
    async with nursery("keep") as (orphans, server):
        stream, again = await owned_twice(orphans, server)
        orphans.end(stream)
        assert not is_closed(again)
        assert orphans.is_own(stream.goal_id, ANN)


@in_virtual_time()
async def test_a_goal_whose_client_is_lost_again_has_the_whole_grace_again() -> None:
    async with nursery("cancel") as (orphans, server):
        first = await server.goal()
        lose(orphans, server, first, left=False)
        await anyio.sleep(GRACE - 1)
        second = await server.feedback(first.goal_id, own=True)
        lose(orphans, server, second, left=False)
        assert is_closed(first)
        await anyio.sleep(GRACE - 1)
        assert second.status is GoalStatus.EXECUTING
        await anyio.sleep(2)
        assert server.canceled == [first.goal_id]


async def test_a_goal_is_its_senders_until_its_end_was_told() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        assert not orphans.is_own(stream.goal_id, ANN)
        orphans.own(stream, ANN)
        assert orphans.is_own(stream.goal_id, ANN)
        assert not orphans.is_own(stream.goal_id, BOB)
        orphans.adopt(server, stream, left=False)
        assert orphans.is_own(stream.goal_id, ANN)
        orphans.end(stream)
        assert not orphans.is_own(stream.goal_id, ANN)


async def test_a_goal_that_has_ended_is_there_until_its_client_has_heard_of_it() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        goal_id = stream.goal_id
        assert orphans.ended(goal_id, ANN) is None
        orphans.own(stream, ANN)
        assert orphans.ended(goal_id, ANN) is None  # it goes on
        server.go.set()
        await settled()
        assert orphans.ended(goal_id, ANN) is stream
        assert orphans.ended(goal_id, BOB) is None
        orphans.adopt(server, stream, left=False)
        assert orphans.ended(goal_id, ANN) is stream
        orphans.end(stream)
        assert orphans.ended(goal_id, ANN) is None


async def test_a_goal_that_is_sent_again_must_be_the_same() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        goal_id = stream.goal_id
        orphans.own(stream, ANN, b"goal")
        assert not orphans.own(stream, BOB, b"goal")
        server.go.set()
        await settled()
        assert orphans.ended(goal_id, ANN, b"goal") is stream
        with pytest.raises(GoalRejected) as caught:
            orphans.ended(goal_id, ANN, b"another")
        assert (caught.value.reason, caught.value.goal_id) == (ID_IN_USE, goal_id)
        orphans.end(stream)
        assert orphans.ended(goal_id, ANN, b"another") is None


@in_virtual_time()
@pytest.mark.parametrize("then", ["keep", "cancel"])
async def test_an_end_that_nobody_fetches_is_kept_for_the_grace_and_no_longer(
    then: Literal["keep", "cancel"],
) -> None:
    async with nursery(then) as (orphans, server):
        stream = await server.goal()
        server.go.set()
        await settled()
        lose(orphans, server, stream, left=False)
        await anyio.sleep(GRACE - 0.1)
        assert orphans.ended(stream.goal_id, ANN) is stream
        await anyio.sleep(0.2)
        assert orphans.ended(stream.goal_id, ANN) is None
        assert server.canceled == []


@in_virtual_time()
async def test_an_end_that_is_fetched_again_is_kept_until_it_is_heard_of() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        server.go.set()
        await settled()
        lose(orphans, server, stream, left=False)
        await anyio.sleep(GRACE - 1)
        assert orphans.own(stream, ANN)
        await anyio.sleep(2 * GRACE)
        assert orphans.ended(stream.goal_id, ANN) is stream


@in_virtual_time()
async def test_an_end_whose_client_is_lost_again_is_kept_for_the_whole_grace_again() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        server.go.set()
        await settled()
        lose(orphans, server, stream, left=False)
        await anyio.sleep(GRACE - 1)
        lose(orphans, server, stream, left=False)
        await anyio.sleep(GRACE - 1)
        assert orphans.ended(stream.goal_id, ANN) is stream


async def test_a_goal_of_somebody_unnamed_is_nobodys() -> None:
    async with nursery("keep") as (orphans, server):
        stream = await server.goal()
        orphans.own(stream, b"")
        assert not orphans.is_own(stream.goal_id, b"")


async def test_a_goal_that_cannot_be_canceled_is_logged() -> None:
    server = Server(ConnectionLost("the gateway is away"))
    async with nursery("cancel", server) as (orphans, server):
        stream = await server.goal()
        with logged() as lines:
            lose(orphans, server, stream, left=True)
            await settled()
        assert lines[-1].getMessage() == (
            f"goal {stream.goal_id} could not be canceled: the gateway is away"
        )


async def test_an_endpoint_that_raises_what_it_may_not_harms_nobody_else() -> None:
    server = Server(ValueError("a bug"))
    async with nursery("cancel", server) as (orphans, server):
        lose(orphans, server, await server.goal(), left=True)
        await settled()


async def test_no_stream_is_left_open_when_the_hub_ends() -> None:
    server = Server()
    async with server:
        async with Background() as tasks:
            stream = await server.goal()
            orphans = Owners(tasks, grace=GRACE, then="keep")
            lose(orphans, server, stream, left=False)
            await settled()
            orphans.close()
        assert is_closed(stream)


async def test_a_goal_of_one_session_cannot_be_taken_over_by_another() -> None:
    async with nursery("cancel") as (orphans, server):
        stream = await server.goal()
        assert orphans.own(stream, ANN)
        other = await server.feedback(stream.goal_id, own=True)
        assert not orphans.own(other, BOB)
        assert not is_closed(stream)
        assert orphans.is_own(stream.goal_id, ANN)
        assert not orphans.is_own(stream.goal_id, BOB)
        orphans.end(stream)
        server.go.set()
