"""Topics between our RTPS and Cyclone DDS in another process."""

from __future__ import annotations

import signal
import uuid

import pytest

from fibaction_transports.rtps.events import (
    EndpointUnmatched,
    ParticipantFound,
    ParticipantLost,
    QosMismatch,
)
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS
from fibaction_transports.rtps.qos import Durability, Qos, Reliability
from tests.support.rtps_end import TEXT, rtps_end, text
from tests.transports.cyclone.partner import matched, needs_cyclone, partner

pytestmark = [pytest.mark.anyio, needs_cyclone]

SIZES = [("a", 1), ("b", 1_000_000), ("c", 1), ("d", 8_000_000), ("e", 7)]
ALL = Qos(depth=None)
KEPT = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
BEST_EFFORT = Qos(reliability=Reliability.BEST_EFFORT)


def topic() -> str:
    return f"rt/t{uuid.uuid4().hex}"


async def test_samples_of_every_size_cross_each_other_and_arrive_in_order() -> None:
    there, back = topic(), topic()
    async with partner("topics") as cyclone, rtps_end() as ours:
        await cyclone.ask("read", topic=there, name="in")
        await cyclone.ask("write", topic=back, name="out")
        writer, reader = await ours.writer(there, ALL), await ours.reader(back, ALL)
        await matched(cyclone, 1, "out")
        for letter, times in SIZES:
            ours.network.write(writer, text(letter * times))
        await cyclone.ask("send", texts=SIZES, name="out")
        heard = await cyclone.ask("heard", count=len(SIZES), name="in")
        assert heard == [[letter, times, 1] for letter, times in SIZES]
        await ours.until_heard(reader, len(SIZES))
        assert ours.texts(reader) == [letter * times for letter, times in SIZES]
        participant = ours.network.participant
        assert participant.vendor_of(next(iter(writer.readers)).prefix) == CYCLONE_DDS
        assert (participant.counters.invalid, participant.counters.over_limit) == (0, 0)


async def test_a_mismatch_with_cyclone_is_told_with_its_reasons() -> None:
    name = topic()
    async with partner("topics") as cyclone, rtps_end() as ours:
        await cyclone.ask("write", topic=name, reliable=False)
        ours.network.create_reader(name, TEXT, Qos())
        await ours.until(lambda: ours.all(QosMismatch))
        (mismatch,) = ours.all(QosMismatch)
        assert mismatch.reasons == (
            "reliability: the writer offers best_effort, the reader requests reliable",
        )


async def test_a_sample_for_one_reader_only_reaches_no_other() -> None:
    name = topic()
    async with partner("topics") as one, partner("topics") as other, rtps_end() as ours:
        await one.ask("read", topic=name)
        first = await ours.writer(name, ALL)
        (own,) = first.readers
        await other.ask("read", topic=name)
        await ours.until(lambda: len(first.readers) == 2)
        ours.network.write(first, text("a" * 200_000), only_to=own)
        ours.network.write(first, text("b"))
        assert await one.ask("heard", count=2) == [["a", 200_000, 1], ["b", 1, 1]]
        assert await other.ask("heard", count=1) == [["b", 1, 1]]


async def test_the_end_of_cyclone_is_seen_at_once() -> None:
    name = topic()
    async with rtps_end() as ours:
        async with partner("topics") as cyclone:
            await cyclone.ask("write", topic=name)
            await ours.reader(name, ALL)
        await ours.until(lambda: ours.all(ParticipantLost))
        assert [event.has_left for event in ours.all(ParticipantLost)] == [True]
        assert ours.all(EndpointUnmatched)


async def test_our_end_is_seen_by_cyclone_at_once() -> None:
    name = topic()
    async with partner("topics") as cyclone:
        await cyclone.ask("read", topic=name)
        async with rtps_end() as ours:
            await ours.writer(name, ALL)
            await matched(cyclone)
        await matched(cyclone, 0)


async def test_a_cyclone_that_is_killed_is_lost_when_its_lease_is_over() -> None:
    name = topic()
    async with partner("topics", lease="500 ms") as cyclone, rtps_end() as ours:
        await cyclone.ask("write", topic=name)
        await ours.reader(name, ALL)
        cyclone.signal(signal.SIGKILL)
        await ours.until(lambda: ours.all(ParticipantLost))
        assert [event.has_left for event in ours.all(ParticipantLost)] == [False]
        assert len(ours.all(ParticipantFound)) == 1
