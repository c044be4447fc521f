"""The limits of a server as a whole: what the client that reaches one is told."""

from __future__ import annotations

import pytest

from fibaction.wire.messages import (
    Ended,
    Failed,
    Follow,
    Following,
    Received,
    Rejected,
    Why,
)
from tests.hostile.attack import MIB, MOST, goal_id, sending
from tests.hostile.floods import SHORT
from tests.hostile.goal_attacks import ONE, begun, ticking
from tests.hostile.test_limits import limited, payload, pytestmark
from tests.hostile.victim import GROW, Sized

__all__ = ["pytestmark"]


async def test_one_active_goal_of_the_server_too_many_is_rejected() -> None:
    async with limited(server={"max_goals": 4}) as target:
        async with target.dial() as raw, target.dial() as other:
            for id in range(1, 4):
                await begun(raw, sending(id, "forever", ONE, None))
            await begun(other, sending(1, "forever", ONE, None))
            await other.say(sending(2, "forever", ONE, None))
            assert isinstance(await other.answer(2), Rejected)


async def test_a_goal_is_rejected_while_the_accepted_ones_hold_too_many_bytes() -> None:
    async with (
        limited(server={"max_bytes": 4 * MIB}, frame=2 * MIB) as target,
        target.dial() as raw,
    ):
        answers = []
        for id in range(1, 6):
            await raw.say(sending(id, "hold", payload(MIB), None))
            answers.append(await raw.answer(id))
        assert isinstance(answers[0], Following)
        assert isinstance(answers[-1], Rejected)


async def test_results_that_are_too_large_together_are_forgotten() -> None:
    async with (
        limited(server={"max_bytes": 4 * MIB}, frame=2 * MIB) as target,
        target.dial() as raw,
    ):
        goal = GROW.goal.encode(Sized(MIB))
        names = [goal_id() for _ in range(8)]
        for id, name in enumerate(names, 1):
            await raw.say(sending(id, "grow", goal, MOST, name))
            await raw.hear(Ended, id)
            await raw.say(Received(id))
        await raw.say(Follow(100, "grow", names[0], None, False, None))
        failed = await raw.answer(100)
        assert isinstance(failed, Failed)
        assert failed.why == Why.UNKNOWN_GOAL
        await raw.say(Follow(101, "grow", names[-1], None, False, None))
        assert isinstance(await raw.answer(101), Following)


async def test_feedback_without_a_reader_has_a_limit_in_bytes_and_its_goal_goes_on() -> None:
    async with limited(server={"max_bytes": 4 * MIB, "stall_timeout": 0.1}) as target:
        async with target.dial() as raw:
            await raw.say(sending(1, "ticker", ticking(0.0, MIB, 20), 0))
            await raw.hear(Following, 1)
            await raw.say(Follow(2, "ticker", goal_id(), None, False, None))
            await raw.hear(Failed, 2)
            async with target.dial() as other:  # other goals are accepted beside it
                await other.say(sending(1, "fibonacci", SHORT))
                await other.hear(Ended, 1)


@pytest.mark.promise("RESULT-9")
async def test_results_that_one_client_does_not_read_push_out_no_results_of_others() -> None:
    goal = GROW.goal.encode(Sized(MIB))
    async with (
        limited(server={"max_bytes": 8 * MIB}, frame=2 * MIB) as target,
        target.dial() as honest,
        target.dial() as raw,
    ):
        name = goal_id()
        await honest.say(sending(1, "grow", goal, MOST, name))
        await honest.hear(Ended, 1)
        names = [goal_id() for _ in range(20)]
        for id, one in enumerate(names, 1):  # without `Received`, a result counts as unread
            await raw.say(sending(id, "grow", goal, MOST, one))
            if isinstance(rejected := await raw.answer(id), Rejected):
                break
            await raw.hear(Ended, id)
        assert isinstance(rejected, Rejected)
        assert rejected.reason.startswith("busy: its client has not read results of ")
        await raw.say(Follow(101, "grow", names[0], None, False, None))
        failed = await raw.answer(101)
        assert isinstance(failed, Failed)
        assert failed.why == Why.UNKNOWN_GOAL
        await honest.say(Follow(2, "grow", name, None, False, None))
        assert isinstance(await honest.answer(2), Following)
        await honest.hear(Ended, 2)
