from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import anyio
import pytest
from anyio.abc import ByteStream

from fibaction.wire.channel import CHUNK, StreamChannel
from fibaction.wire.frames import HEADER, FrameReader, header
from fibaction.words.errors import ConnectionLost, ProtocolError
from tests.support.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio

LIMIT = 2**20
BREAKS = [
    OSError("no route"),
    ConnectionResetError("reset"),
    anyio.BrokenResourceError(),
    anyio.ClosedResourceError(),
]
broken = pytest.mark.parametrize("error", BREAKS, ids=lambda error: type(error).__name__)


class FakeStream(ByteStream):
    """Notes what is sent, and gives the pieces that it is told to; then it ends."""

    def __init__(self, *pieces: bytes) -> None:
        self.pieces = deque(pieces)
        self.sent: list[bytes] = []
        self.error: Exception | None = None
        self.asked: list[int] = []
        self.wait: Callable[[], Any] = anyio.lowlevel.checkpoint
        """What each call waits for."""
        self.closed = False

    async def receive(self, max_bytes: int = 65536) -> bytes:
        self.asked.append(max_bytes)
        await self.wait()
        if self.error is not None:
            raise self.error
        if not self.pieces:
            raise anyio.EndOfStream
        return self.pieces.popleft()

    async def send(self, item: bytes) -> None:
        await self.wait()
        if self.error is not None:
            raise self.error
        self.sent.append(item)

    async def send_eof(self) -> None:
        raise NotImplementedError

    async def aclose(self) -> None:
        await self.wait()
        if self.error is not None:
            raise self.error
        self.closed = True


def channel_over(stream: ByteStream, limit: int = LIMIT) -> StreamChannel:
    return StreamChannel(stream, "10.0.0.1:7400", FrameReader(limit))


def framed(*frames: bytes) -> bytes:
    return b"".join(header(len(frame)) + frame for frame in frames)


async def received(channel: StreamChannel) -> list[list[bytes]]:
    """What comes at once, until the peer closes."""
    batches = []
    with anyio.fail_after(5), pytest.raises(ConnectionLost, match="closed its side"):
        while True:
            batches.append(await channel.receive())
    return batches


# Sending and receiving


async def test_small_frames_are_written_at_once() -> None:
    stream = FakeStream()
    await channel_over(stream).send([b"one", b"", b"three"])
    assert stream.sent == [framed(b"one", b"", b"three")]


@pytest.mark.parametrize(
    ("size", "pieces"),
    [
        (CHUNK - HEADER, [CHUNK]),
        (CHUNK - HEADER + 1, [CHUNK, 1]),
        (3 * CHUNK, [CHUNK, CHUNK, CHUNK, HEADER]),
    ],
)
async def test_large_frames_are_written_in_pieces(size: int, pieces: list[int]) -> None:
    stream = FakeStream()
    frame = bytes(range(256)) * (size // 256 + 1)
    await channel_over(stream).send([frame[:size]])
    assert [len(piece) for piece in stream.sent] == pieces
    assert b"".join(stream.sent) == framed(frame[:size])


async def test_frames_that_are_there_come_at_once_and_others_when_they_are_complete() -> None:
    data = framed(b"one", b"two", b"three")
    stream = FakeStream(data[:16], data[16:17], data[17:-1], data[-1:])
    pieces = await received(channel_over(stream))
    assert pieces == [[b"one", b"two"], [], [], [b"three"]]
    assert set(stream.asked) == {CHUNK}


# How a connection ends


@pytest.mark.parametrize("length", [1, HEADER, HEADER + 2])
async def test_a_peer_that_closes_within_a_message_is_told_apart(length: int) -> None:
    channel = channel_over(FakeStream(framed(b"one") + framed(b"two")[:length]))
    assert await channel.receive() == [b"one"]
    with pytest.raises(ConnectionLost) as caught:
        await channel.receive()
    assert str(caught.value) == "10.0.0.1:7400 closed in the middle of a message"


@broken
async def test_a_line_that_breaks_is_a_lost_connection_for_the_sender(error: Exception) -> None:
    stream = FakeStream()
    stream.error = error
    with pytest.raises(ConnectionLost, match=r"^the connection to 10\.0\.0\.1:7400 broke$") as lost:
        await channel_over(stream).send([b"one"])
    assert lost.value.__cause__ is error


async def test_each_piece_that_a_slow_peer_takes_is_progress() -> None:
    stream, taken = FakeStream(), anyio.Semaphore(0)
    stream.wait = taken.acquire
    channel = channel_over(stream)
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(channel.send, [bytes(10 * CHUNK)])
            for number in range(11):  # with the header, it is a little more than ten pieces
                await anyio.wait_all_tasks_blocked()
                assert channel.progress == number
                taken.release()
    assert channel.progress == 11


async def test_a_wait_for_frames_can_be_canceled_and_nothing_is_lost() -> None:
    data = framed(b"one")
    stream, arrived = FakeStream(*(bytes([byte]) for byte in data)), anyio.Semaphore(0)
    stream.wait = arrived.acquire
    channel = channel_over(stream)
    frames: list[bytes] = []
    with anyio.fail_after(5):
        for _ in data:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(channel.receive)
                await anyio.wait_all_tasks_blocked()
                tasks.cancel_scope.cancel()
            arrived.release()
            frames += await channel.receive()
    assert frames == [b"one"]


async def test_after_half_a_frame_nothing_more_is_sent() -> None:
    stream = FakeStream()

    async def let_one_through() -> None:
        if stream.sent:
            await anyio.sleep_forever()

    stream.wait = let_one_through
    channel = channel_over(stream)
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(channel.send, [bytes(2 * CHUNK)])
            await anyio.wait_all_tasks_blocked()
            tasks.cancel_scope.cancel()
        assert len(stream.sent) == 1
        stream.wait = anyio.lowlevel.checkpoint
        with pytest.raises(ConnectionLost):
            await channel.send([b"goodbye"])
    assert len(stream.sent) == 1


# Closing


@broken
async def test_closing_what_is_broken_raises_nothing(error: Exception) -> None:
    stream = FakeStream()
    stream.error = error
    with anyio.fail_after(5):
        await channel_over(stream).aclose()
    assert not stream.closed


@in_virtual_time()
async def test_closing_waits_no_longer_than_a_second() -> None:
    stream = FakeStream()
    stream.wait = anyio.sleep_forever
    start = anyio.current_time()
    await channel_over(stream).aclose()
    assert anyio.current_time() - start == 1


async def test_a_channel_is_closed_also_by_a_task_that_is_being_canceled() -> None:
    stream = FakeStream()
    with anyio.fail_after(5), anyio.CancelScope() as scope:
        scope.cancel()
        await channel_over(stream).aclose()
    assert stream.closed


# Running


class QuietStream(FakeStream):
    """One from which nothing comes."""

    async def receive(self, max_bytes: int = 65536) -> bytes:
        await anyio.sleep_forever()
        raise AssertionError("it never returns")


class Running:
    """A channel that runs: what it hands over, and what it is given to send."""

    def __init__(self, *pieces: bytes) -> None:
        self.stream = FakeStream(*pieces) if pieces else QuietStream()
        self.channel = StreamChannel(self.stream, "the peer", FrameReader())
        self.heard: list[bytes] = []
        self.to_say: list[list[bytes]] = []
        self.error: Exception | None = None

    def on_frames(self, frames: list[bytes]) -> list[bytes]:
        self.heard += frames
        return []

    def next_frames(self) -> list[bytes]:
        return self.to_say.pop(0) if self.to_say else []

    async def run(self) -> None:
        with anyio.fail_after(5):
            try:
                await self.channel.run(self.on_frames, self.next_frames)
            except Exception as exc:
                self.error = exc


async def test_what_there_is_to_send_is_fetched_at_first_and_when_it_is_stirred() -> None:
    running = Running()
    running.channel.wake_writer()  # it does not run yet, and will ask anyway
    running.to_say = [[b"1"], [b"2", b"3"]]
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(running.run)
        await anyio.wait_all_tasks_blocked()
        assert running.stream.sent == [framed(b"1"), framed(b"2", b"3")]
        running.to_say = [[b"4"]]
        running.channel.wake_writer()
        await anyio.wait_all_tasks_blocked()
        assert running.stream.sent[2:] == [framed(b"4")]
        tasks.cancel_scope.cancel()


async def test_what_hear_raises_ends_the_run_and_is_not_wrapped() -> None:
    running = Running(framed(b"1"), framed(b"2"))
    wrong = ProtocolError("no such message")

    def on_frames(frames: list[bytes]) -> list[bytes]:
        running.heard.extend(frames)
        raise wrong

    with anyio.fail_after(5), pytest.raises(ProtocolError) as caught:
        await running.channel.run(on_frames, running.next_frames)
    assert caught.value is wrong
    assert running.heard == [b"1"]


async def test_frames_that_are_given_back_come_again_in_a_later_turn_and_nothing_is_read() -> None:
    running = Running(framed(b"1", b"2", b"3"), framed(b"4"))
    turns: list[tuple[int, list[bytes], int]] = []
    turn = 0

    def on_frames(frames: list[bytes]) -> list[bytes]:
        turns.append((turn, frames, len(running.stream.asked)))
        return frames[1:]

    async def count_turns() -> None:
        nonlocal turn
        while True:
            await anyio.lowlevel.checkpoint()
            turn += 1

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(count_turns)
        with anyio.fail_after(5), pytest.raises(ConnectionLost):
            await running.channel.run(on_frames, running.next_frames)
        tasks.cancel_scope.cancel()
    assert [frames for _, frames, _ in turns] == [[b"1", b"2", b"3"], [b"2", b"3"], [b"3"], [b"4"]]
    assert [asked for *_, asked in turns] == [1, 1, 1, 2]
    # trio runs the tasks of a turn in any order, so two calls may have the same number.
    first, second, third, fourth = (turn for turn, *_ in turns)
    assert first < third
    assert second < fourth


async def test_channels_that_share_turns_handle_their_rests_one_after_the_other() -> None:
    turns: list[int] = []
    turn, lock = 0, anyio.Lock()
    busy = [Running(framed(b"1", b"2", b"3", b"4")) for _ in range(5)]

    def on_frames(frames: list[bytes]) -> list[bytes]:
        if len(frames) < 4:
            turns.append(turn)
        return frames[1:]

    async def run(running: Running) -> None:
        with pytest.raises(ConnectionLost):
            await running.channel.run(on_frames, running.next_frames)

    async def count_turns() -> None:
        nonlocal turn
        while True:
            await anyio.lowlevel.checkpoint()
            turn += 1

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(count_turns)
        with anyio.fail_after(5):
            async with anyio.create_task_group() as running:
                for one in busy:
                    one.channel.share_turns(lock)
                    running.start_soon(run, one)
        tasks.cancel_scope.cancel()
    assert len(turns) == 15
    assert max(turns.count(one) for one in turns) <= 2  # tasks and turns begin in any order


async def test_a_write_that_fails_ends_the_run() -> None:
    running = Running()
    running.stream.error = OSError("no route")
    running.to_say = [[b"1"]]
    await running.run()
    assert isinstance(running.error, ConnectionLost)


class Polite(FrameReader):
    """A form with a question, an answer and a goodbye of its own."""

    def __init__(self, *, ends_stream: bool = False) -> None:
        super().__init__()
        self.ends_stream = ends_stream
        self.is_closed = False

    def feed(self, data: bytes) -> list[bytes]:
        self.has_answer = data == b"?"
        return []

    def encode(self, frames: Sequence[bytes]) -> bytes:
        self.has_answer = False
        return b"!" + super().encode(frames)

    def goodbye(self) -> bytes:
        return b"bye"

    def discard(self, data: bytes) -> None:
        self.is_closed = data == b"bye"


async def test_a_channel_that_runs_sends_the_answer_by_itself() -> None:
    answered = anyio.Event()

    class Waiting(FakeStream):
        async def receive(self, max_bytes: int = 65536) -> bytes:
            if not self.pieces:
                await answered.wait()
            return await super().receive(max_bytes)

        async def send(self, item: bytes) -> None:
            await super().send(item)
            answered.set()

    stream = Waiting(b"?")
    channel = StreamChannel(stream, "the peer", Polite())
    with anyio.fail_after(5), pytest.raises(ConnectionLost):
        await channel.run(lambda frames: [], list)
    assert stream.sent == [b"!"]


@pytest.mark.parametrize(
    "pieces", [(b"more", b"bye"), (b"more",)], ids=["which answers", "which does not"]
)
async def test_the_goodbye_of_the_form_is_said_and_the_peer_may_answer(
    pieces: tuple[bytes, ...],
) -> None:
    stream = FakeStream(*pieces)
    await StreamChannel(stream, "the peer", Polite()).aclose()
    assert (stream.sent, stream.closed, list(stream.pieces)) == ([b"bye"], True, [])


async def test_a_form_may_end_the_stream_with_its_goodbye() -> None:
    ends: list[list[bytes]] = []

    class Ending(FakeStream):
        async def send_eof(self) -> None:
            ends.append(self.sent[:])

    class Tls(FakeStream):
        async def send_eof(self) -> None:
            raise NotImplementedError

    for kind in (Ending, Tls):
        stream = kind()
        await StreamChannel(stream, "the peer", Polite(ends_stream=True)).aclose()
        assert stream.closed
    assert ends == [[b"bye"]]
