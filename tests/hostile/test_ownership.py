"""Clients that ask for the goals and the sessions of others."""

from __future__ import annotations

from time import monotonic

import anyio
import pytest

from fibaction.wire.messages import (
    CancelGoals,
    Credit,
    Ended,
    Failed,
    Follow,
    Following,
    Goodbye,
    Welcome,
    Why,
)
from tests.hostile.arena import PATIENCE, SHUTDOWN, started
from tests.hostile.attack import MOST, goal_id, sending
from tests.hostile.goal_attacks import ONE, begun, ticking
from tests.hostile.raw_client import Target
from tests.hostile.victim import Settings

pytestmark = pytest.mark.asyncio

FAILED, FEEDBACK, ENDED = 35, 36, 38  # tags
TOKENS = {"honest": "honest", "hostile": "hostile"}


async def test_a_goal_that_another_client_sends_again_is_not_held_up_by_it() -> None:
    name, goal = goal_id(), ticking(0.0, 10, 600)  # more than the server remembers
    with started(Settings()) as server, anyio.fail_after(PATIENCE):
        target = Target(server.url)
        async with target.dial(session=b"h" * 32) as owner, target.dial(session=b"a" * 32) as other:
            await begun(owner, sending(1, "ticker", goal, 0, name))
            for id in range(1, 4):
                await other.say(sending(id, "ticker", goal, 0, name))
                await other.hear(Following, id)
            sent = monotonic()
            await owner.say(Credit(1, MOST))
            await owner.hear(Ended, 1)
            assert monotonic() - sent < 9  # an owner would hold it for 10 s


async def test_a_goal_that_another_client_sends_again_is_not_shown_without_the_permission() -> None:
    name, goal = goal_id(), ticking(0.05)
    settings = Settings(wire={"tokens": TOKENS}, authorize="only_send")
    with started(settings) as server, anyio.fail_after(PATIENCE):
        hostile, honest = Target(server.url, "hostile"), Target(server.url, "honest")
        async with honest.dial(session=b"h" * 32) as owner, hostile.dial() as other:
            await begun(owner, sending(1, "ticker", goal, MOST, name))
            await other.say(sending(1, "ticker", goal, MOST, name))
            failed = await other.answer(1)
            assert isinstance(failed, Failed)
            assert failed.why == Why.FORBIDDEN
            await other.fence()
            assert other.counts[FEEDBACK] == 0


async def test_a_session_is_of_no_use_with_another_token() -> None:
    session, name = b"s" * 32, goal_id()
    settings = Settings(wire={"tokens": TOKENS}, authorize="only_send")
    with started(settings) as server, anyio.fail_after(PATIENCE):
        hostile, honest = Target(server.url, "hostile"), Target(server.url, "honest")
        async with honest.dial(session=session) as owner:
            await begun(owner, sending(1, "forever", ONE, 0, name))
            async with hostile.dial(session=session) as thief:
                await thief.hear(Welcome)
                await thief.say(Follow(1, "forever", name, None, True, MOST))
                failed = await thief.answer(1)
                assert isinstance(failed, Failed)
                assert failed.why == Why.FORBIDDEN
                await owner.fence()
            assert owner.is_open


async def test_goals_are_not_canceled_without_the_permission() -> None:
    settings = Settings(wire={"tokens": TOKENS}, authorize="only_send")
    with started(settings) as server, anyio.fail_after(PATIENCE):
        hostile, honest = Target(server.url, "hostile"), Target(server.url, "honest")
        async with honest.dial(session=b"h" * 32) as owner, hostile.dial() as other:
            goal = await begun(owner, sending(1, "forever", ONE, MOST))
            for which in (None, goal.goal_id, bytes(16)):
                for stamp in (None, 0, 2**63 - 1):
                    await other.say(CancelGoals(next(other.ids), "forever", which, stamp))
            await other.fence()
            assert other.counts[FAILED] == 9
            await owner.fence()
            assert owner.counts[ENDED] == 0


async def test_the_last_words_to_a_connection_whose_session_moved_on_are_a_goodbye() -> None:
    with started(Settings()) as server, anyio.fail_after(PATIENCE):
        target = Target(server.url)
        async with target.dial(session=b"s" * 32) as first:
            await first.hear(Welcome)
            async with target.dial(session=b"s" * 32) as second:
                await second.hear(Welcome)
                await first.hear(Goodbye)
                await first.ended()
                await second.fence()


async def test_an_executor_that_swallows_its_cancellations_does_not_keep_the_server() -> None:
    with started(Settings()) as server, anyio.fail_after(PATIENCE):
        async with Target(server.url).dial() as raw:
            await begun(raw, sending(1, "stubborn", ONE))
            _, code = await server.stop(SHUTDOWN + 10)
            assert code == 0
            assert "stubborn" in server.log
