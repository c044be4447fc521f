"""The turns that the messages of one connection leave to all others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from fibaction.border.event_loop import SLICE
from fibaction.wire.channel import CHUNK, Line, NextFrames, OnFrames
from fibaction.wire.link import Link
from fibaction.wire.messages import ListActions
from tests.support.slices import SliceClock
from tests.wire.ends import BOB, held, serving
from tests.wire.memory import LONG, settled

pytestmark = pytest.mark.anyio


@pytest.fixture
def slow(slice_clock: SliceClock) -> None:
    """Each look at the clock takes half a slice."""
    slice_clock.step = SLICE / 2


class Handed(Line):
    """A line whose frames a test hands over."""

    peer = "the peer"

    def __init__(self) -> None:
        self.on_frames: OnFrames
        self.next_frames: NextFrames

    def wake_writer(self, *, at_once: bool = False) -> None:
        pass

    async def run(self, on_frames: OnFrames, next_frames: NextFrames) -> None:
        self.on_frames, self.next_frames = on_frames, next_frames
        await anyio.sleep_forever()

    async def send(self, frames: Any) -> None:
        raise AssertionError

    async def aclose(self) -> None:
        raise AssertionError


async def running(handle: Callable[[bytes], None], tasks: Any) -> tuple[Handed, Link]:
    line = Handed()
    link = Link(line, LONG)
    tasks.start_soon(link.run, handle)
    await settled()
    return line, link


@pytest.mark.usefixtures("slow")
async def test_after_a_slice_the_rest_of_the_frames_goes_back_to_the_line() -> None:
    heard: list[bytes] = []
    frames = [b"%d" % number for number in range(5)]
    async with anyio.create_task_group() as tasks:
        line, _ = await running(heard.append, tasks)
        rest = line.on_frames(frames)
        assert heard == frames[:2]
        assert rest == frames[2:]
        while rest:
            rest = line.on_frames(rest)
        assert heard == frames
        tasks.cancel_scope.cancel()


async def test_the_queue_is_written_in_pieces() -> None:
    async with anyio.create_task_group() as tasks:
        line, link = await running(lambda frame: None, tasks)
        sent = [bytes([number]) * (CHUNK // 4) for number in range(10)]
        for frame in sent[:9]:
            link.post(frame)
        await link.send(lambda: sent[9])
        writes: list[list[bytes]] = []
        while frames := line.next_frames():
            writes.append(frames)
        assert [len(frames) for frames in writes] == [4, 4, 2]
        assert [frame for frames in writes for frame in frames] == sent
        assert (link._queued, link._posted) == (0, 0)
        tasks.cancel_scope.cancel()


@pytest.mark.usefixtures("slow")
async def test_a_flood_of_requests_lets_other_clients_have_their_turns() -> None:
    async with serving(held()) as served:
        busy, other = await served.greet(), await served.greet(BOB)
        await busy.say(*(ListActions(number) for number in range(500)))
        assert await other.is_served()
        heard = busy.channel._incoming.frames  # so far
        assert len(heard) < 250
        assert len(await busy.hear_all()) == 500
