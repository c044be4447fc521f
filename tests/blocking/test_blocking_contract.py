"""The main cases of the contract, for clients of plain code: `fibaction.blocking`."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from typing import TypeVar

import anyio
import pytest
from anyio import to_thread

from fibaction import (
    ActionServer,
    GoalCanceled,
    GoalHandle,
    GoalStatus,
    GoalTimeout,
    blocking,
)
from fibaction.testing.contract.reach import Reach
from tests.contract.conftest import WAYS, skip_if_unable
from tests.support.certificates import pems
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result, fibonacci

pytestmark = pytest.mark.anyio

IN_ANOTHER_THREAD = [
    way for way in WAYS if way not in ("inproc", "gateway", "inproc, with a store")
]
"""The ways whose clients need not be on the event loop of their server."""


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=IN_ANOTHER_THREAD)
def reach(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Reach:
    skip_if_unable(request.param, request)
    monkeypatch.setenv("SSL_CERT_FILE", pems().ca)
    return WAYS[request.param]


Client = blocking.BlockingClient[Goal, Feedback, Result]
T = TypeVar("T")


async def used_by(
    reach: Reach, server: ActionServer[Goal, Feedback, Result], use: Callable[[Client], T]
) -> T:
    """Serve, and let plain code in another thread use a client."""

    def in_a_block(url: str) -> T:
        with blocking.connect(url, FIBONACCI) as client:
            return use(client)

    async with reach.url(server) as url:
        return await to_thread.run_sync(in_a_block, url)


async def held(goal: GoalHandle[Goal]) -> AsyncGenerator[Feedback | Result, None]:
    """Tell one feedback, wait until the goal is canceled, and tell what is there."""
    yield Feedback([1])
    try:
        await anyio.sleep_forever()
    except anyio.get_cancelled_exc_class():
        raise GoalCanceled("as asked", result=Result([1])) from None


async def test_a_call_returns_the_result_after_all_feedback(reach: Reach) -> None:
    def use(client: Client) -> tuple[Result, list[Feedback]]:
        seen: list[Feedback] = []
        return client.call(Goal(4), on_feedback=seen.append), seen

    result, seen = await used_by(reach, ActionServer(FIBONACCI, fibonacci), use)
    assert result == Result([0, 1, 1, 2, 3])
    assert seen == [Feedback([0, 1, 1]), Feedback([0, 1, 1, 2]), Feedback([0, 1, 1, 2, 3])]


async def test_all_feedback_arrives_in_order(reach: Reach) -> None:
    def use(client: Client) -> tuple[list[Feedback], Result]:
        with client.send_goal(Goal(60)) as goal:
            return list(goal.feedback), goal.result()

    server = ActionServer(FIBONACCI, fibonacci, feedback_window=4)
    seen, result = await used_by(reach, server, use)
    assert [len(item.partial_sequence) for item in seen] == list(range(3, 62))
    assert seen[-1].partial_sequence == result.sequence


async def test_a_canceled_goal_ends_with_what_is_there(reach: Reach) -> None:
    def use(client: Client) -> None:
        with client.send_goal(Goal(1)) as goal:
            assert next(goal.feedback) == Feedback([1])
            assert goal.cancel().accepted
            outcome = goal.outcome()
            assert (outcome.status, outcome.result) == (GoalStatus.CANCELED, Result([1]))
            with pytest.raises(GoalCanceled, match="as asked"):
                goal.result()

    await used_by(reach, ActionServer(FIBONACCI, held), use)


async def test_a_goal_that_takes_too_long_is_canceled(reach: Reach) -> None:
    def use(client: Client) -> None:
        with pytest.raises(GoalTimeout) as caught:
            client.call(Goal(1), timeout=0.5)  # a busy machine accepts it within that time
        assert caught.value.goal_id is not None
        outcome = client.attach(caught.value.goal_id).outcome()
        assert outcome.status is GoalStatus.CANCELED

    await used_by(reach, ActionServer(FIBONACCI, held), use)
