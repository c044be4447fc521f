"""The payload, the parent and the labels of a goal in `Following`: who is told them, and when."""

from __future__ import annotations

import msgspec
import pytest
from msgspec.structs import replace

from fibaction import GoalID, GoalInfo, Parent
from fibaction.wire.frames import LEAST_FRAME
from fibaction.wire.messages import Follow, Following, SendGoal
from tests.wire.ends import (
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    GOAL_ID,
    A,
    endpoint_of,
    follow,
    held,
    reached,
    serving,
)
from tests.wire.memory import Running

pytestmark = pytest.mark.anyio


async def test_a_client_that_goes_on_with_its_own_goal_is_not_told_it_again() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        await client.send(1)
        client.channel.cut()
        client = await served.greet()
        assert (await client.ask(follow(0), Following)).goal is None


async def test_a_goal_over_the_clients_limit_is_left_out() -> None:
    padded = msgspec.msgpack.encode({"order": 3, "unknown": bytes(4096)})
    async with serving(held()) as served:
        sender = await served.greet()
        await sender.ask(SendGoal(1, "fibonacci", A, padded, ANY, checked=True), Following)
        small, large_enough = await served.greet(BOB, max_frame=LEAST_FRAME), await served.greet()
        assert (await small.ask(follow(None, own=False), Following)).goal is None
        assert (await large_enough.ask(follow(None, own=False), Following)).goal == padded


async def test_a_client_that_follows_a_goal_of_another_one_is_told_its_labels() -> None:
    labeled = SendGoal(1, "fibonacci", A, GOAL, ANY, None, {"order": "17", "traceparent": "00-1"})
    async with serving(held()) as served:
        sender, observer = await served.greet(), await served.greet(BOB)
        assert (await sender.ask(labeled, Following)).labels is None
        assert (await observer.ask(follow(None, own=False), Following)).labels == {"order": "17"}


async def test_a_stream_of_a_client_knows_the_parent_and_the_labels_that_it_was_told() -> None:
    async with reached() as (connection, server):
        endpoint = endpoint_of(connection)
        async with Running(lambda: endpoint.feedback(GOAL_ID)) as following:
            asked = await server.hear(Follow)
            parent = (bytes([7] * 16), "x" * 200)
            labels = {str(number): "" for number in range(9)}
            await server.say(Following(asked.id, 7, EXECUTING, False, 3, 1, None, parent, labels))
            stream = await following.answer()
    info = GoalInfo(GOAL_ID, 7, EXECUTING, feedback_count=3)
    parent_told = Parent(GoalID(bytes([7] * 16)), "x" * 99 + "…")
    fits = {str(number): "" for number in range(8)}
    assert stream.info == replace(info, parent=parent_told, labels=fits)
    stream.told_info = GoalInfo(GOAL_ID, 7, EXECUTING, worker="a")
    assert stream.info == stream.told_info
