from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import anyio
import pytest
import trio
from anyio.abc import ByteStream
from trio.testing import MockClock

from fibaction._notify import Notifier
from fibaction.exceptions import (
    ActionError,
    AuthenticationFailed,
    ConnectionLost,
    ProtocolError,
)
from fibaction.wire.channel import Channel, StreamChannel
from fibaction.wire.framing import header
from fibaction.wire.heartbeat import MISSED
from fibaction.wire.link import HIGH_WATER, OVERFULL, PING, Link, naming
from fibaction.wire.messages import Ping, decode_from_client, decode_from_server
from tests.virtual_time import in_virtual_time

pytestmark = pytest.mark.anyio

PEER = "10.0.0.1:7400"
RARELY = 1000.0
"""Seconds between signs of life, where a test is not about them."""
OVER = ConnectionLost("the test is over")


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


class FakeChannel(Channel):
    """Notes what is sent, and when; gives what a test lets arrive."""

    def __init__(self) -> None:
        self.peer = PEER
        self.sent: list[list[bytes]] = []
        self.times: list[float] = []
        self.asked = 0
        """How many writes have begun."""
        self.error: ActionError | None = None
        self.is_stuck = False
        self.pause = 0.0
        """Seconds that a write takes."""
        self.pieces = 0
        self._arrived: list[bytes] = []
        self._changed = Notifier()

    @property
    def progress(self) -> int:
        return self.pieces

    def arrive(self, *frames: bytes) -> None:
        self._arrived += frames
        self._changed.notify()

    def fail(self, error: ActionError) -> None:
        self.error = error
        self._changed.notify()

    def unstick(self) -> None:
        self.is_stuck = False
        self._changed.notify()

    async def send(self, frames: Sequence[bytes]) -> None:
        self.asked += 1
        while self.is_stuck:
            await self._changed.wait()
        if self.pause:
            await anyio.sleep(self.pause)
        if self.error is not None:
            raise self.error
        self.sent.append(list(frames))
        self.times.append(anyio.current_time())

    async def receive(self) -> list[bytes]:
        while not self._arrived:
            if self.error is not None:
                raise self.error
            await self._changed.wait()
        arrived, self._arrived = self._arrived, []
        return arrived

    async def aclose(self) -> None:
        raise NotImplementedError  # whoever opened it closes it


class Bench:
    """A link over a fake channel, what it has handled, and how it ended."""

    def __init__(self, heartbeat: float = RARELY, high_water: int = HIGH_WATER) -> None:
        self.channel = FakeChannel()
        self.link = Link(self.channel, heartbeat, high_water)
        self.handled: list[bytes] = []
        self.error: ActionError | None = None
        self.source: Callable[[], list[bytes]] | None = None

    def handle(self, frame: bytes) -> None:
        self.handled.append(frame)

    async def run(self, handle: Callable[[bytes], None] | None = None) -> None:
        self.error = await self.link.run(handle or self.handle, self.source)

    @asynccontextmanager
    async def running(self) -> AsyncGenerator[None, None]:
        """The link runs in the block, and is ended after it."""
        with anyio.fail_after(5):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self.run)
                await anyio.wait_all_tasks_blocked()
                yield
                self.link.end(OVER)


class Waiter:
    """Runs something, and tells whether it still waits."""

    def __init__(self, awaited: Callable[[], Any]) -> None:
        self._awaited = awaited
        self.is_done = False
        self.error: ActionError | None = None

    async def __call__(self) -> None:
        try:
            await self._awaited()
        except ActionError as exc:
            self.error = exc
        self.is_done = True


# What is sent


async def test_what_is_posted_in_one_turn_of_the_loop_is_one_write() -> None:
    bench = Bench()
    async with bench.running():
        bench.link.post(b"one")
        bench.link.post(b"two")
        await bench.link.send(b"three")
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"one", b"two", b"three"]]


async def test_what_several_tasks_post_in_one_turn_of_the_loop_is_one_write() -> None:
    bench = Bench()
    turn = anyio.Event()

    async def post(frame: bytes) -> None:
        await turn.wait()
        bench.link.post(frame)

    async with bench.running(), anyio.create_task_group() as tasks:
        for number in range(10):
            tasks.start_soon(post, b"%d" % number)
        await anyio.wait_all_tasks_blocked()
        turn.set()
        await anyio.wait_all_tasks_blocked()
        (frames,) = bench.channel.sent
        assert sorted(frames) == [b"%d" % number for number in range(10)]


# Trio takes the tasks of a turn in an order of chance, so there it fails every other time only.
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_what_is_posted_during_a_write_goes_into_the_next() -> None:
    bench = Bench()
    async with bench.running():
        bench.channel.is_stuck = True
        bench.link.post(b"one")
        await anyio.wait_all_tasks_blocked()
        bench.link.post(b"two")
        bench.link.post(b"three")
        await anyio.wait_all_tasks_blocked()
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"one"], [b"two", b"three"]]


async def test_what_was_posted_before_it_ran_is_sent_first() -> None:
    bench = Bench()
    bench.link.post(b"hello")
    async with bench.running():
        assert bench.channel.sent == [[b"hello"]]


async def test_a_large_answer_that_waited_for_room_is_not_held_against_the_peer() -> None:
    bench = Bench(high_water=10)
    await bench.link.send(bytes(10 * OVERFULL + 1))
    bench.link.post(b"small")
    bench.link.post(b"small")
    assert bench.link.is_open
    async with bench.running():
        assert [len(frame) for frame in bench.channel.sent[0]] == [10 * OVERFULL + 1, 5, 5]
        assert (bench.link._queued, bench.link._posted) == (0, 0)


# What is fetched


class Spring:
    """A source of messages, and how often it was asked."""

    def __init__(self, bench: Bench) -> None:
        bench.source = self
        self.left: list[list[bytes]] = []
        self.asked = 0

    def __call__(self) -> list[bytes]:
        self.asked += 1
        return self.left.pop(0) if self.left else []


async def test_what_there_is_to_fetch_is_fetched_until_there_is_no_more() -> None:
    bench = Bench()
    spring = Spring(bench)
    async with bench.running():
        assert bench.channel.sent == []
        spring.left = [[b"one", b"two"], [b"three"]]
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == []  # nobody has said that there is something
        bench.link.wake_writer()
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"one", b"two"], [b"three"]]
        assert bench.link._queued == 0  # it was never in the queue
        asked = spring.asked
        await anyio.wait_all_tasks_blocked()
        assert spring.asked == asked


@pytest.mark.parametrize("at_once", [False, True])
async def test_the_line_is_told_whether_there_is_more_to_come(
    at_once: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    told: list[bool] = []
    monkeypatch.setattr(bench.channel, "wake_writer", lambda *, at_once: told.append(at_once))
    bench.link.wake_writer(at_once=at_once)
    assert told == [at_once]


async def test_what_was_there_before_it_ran_is_fetched() -> None:
    bench = Bench()
    Spring(bench).left = [[b"one"]]
    bench.link.wake_writer()
    async with bench.running():
        assert bench.channel.sent == [[b"one"]]


async def test_nothing_is_fetched_as_long_as_the_line_takes_nothing() -> None:
    bench = Bench(high_water=10)
    spring = Spring(bench)
    bench.channel.is_stuck = True
    async with bench.running():
        spring.left = [[bytes(100)]] * 100
        for _ in range(3):
            bench.link.wake_writer()
            await anyio.wait_all_tasks_blocked()
        assert len(spring.left) == 99
        assert bench.link._queued == 0
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[bytes(100)]] * 100


async def test_what_is_posted_goes_before_what_is_fetched_and_into_the_same_write() -> None:
    bench = Bench()
    spring = Spring(bench)
    async with bench.running():
        spring.left = [[b"fetched"]]
        bench.link.wake_writer()
        bench.link.post(b"posted")
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"posted", b"fetched"]]


async def test_what_is_posted_does_not_wait_until_all_is_fetched() -> None:
    bench = Bench()
    spring = Spring(bench)
    bench.channel.is_stuck = True
    async with bench.running():
        spring.left = [[b"fetched"]] * 3
        bench.link.wake_writer()
        await anyio.wait_all_tasks_blocked()
        bench.link.post(b"posted")
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"fetched"], [b"posted", b"fetched"], [b"fetched"]]


async def test_flush_does_not_wait_for_what_there_is_to_fetch() -> None:
    bench = Bench()
    spring = Spring(bench)
    bench.channel.is_stuck = True
    async with bench.running():
        spring.left = [[b"fetched"]]
        bench.link.wake_writer()
        await anyio.wait_all_tasks_blocked()
        with anyio.fail_after(1):
            await bench.link.flush()


async def test_an_error_of_the_source_is_not_taken_for_one_of_the_connection() -> None:
    bench = Bench()

    def source() -> list[bytes]:
        raise LookupError("a bug")

    bench.source = source
    with anyio.fail_after(5), pytest.raises(ExceptionGroup) as caught:
        await bench.run()
    assert caught.group_contains(LookupError, match=r"^a bug$")


# A queue that is full


async def test_who_sends_waits_above_the_high_water_mark_and_goes_on_after() -> None:
    bench = Bench(high_water=10)
    bench.channel.is_stuck = True
    sender = Waiter(lambda: bench.link.send(b"late"))
    async with bench.running(), anyio.create_task_group() as tasks:
        await bench.link.send(bytes(9))  # below the mark there is room for a message of any size
        await anyio.wait_all_tasks_blocked()
        await bench.link.send(bytes(50))
        tasks.start_soon(sender)
        await anyio.wait_all_tasks_blocked()
        assert not sender.is_done
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert sender.is_done
        assert sender.error is None
        assert bench.channel.sent == [[bytes(9)], [bytes(50)], [b"late"]]


async def test_what_is_being_written_counts_until_it_is_written() -> None:
    bench = Bench(high_water=10)
    bench.channel.is_stuck = True
    sender = Waiter(lambda: bench.link.send(b"late"))
    async with bench.running(), anyio.create_task_group() as tasks:
        await bench.link.send(bytes(10))
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.asked == 1
        assert bench.link._queue == []  # all is in the write
        tasks.start_soon(sender)
        await anyio.wait_all_tasks_blocked()
        assert not sender.is_done
        bench.channel.unstick()


async def test_who_posts_never_waits() -> None:
    bench = Bench(high_water=10)
    bench.channel.is_stuck = True
    async with bench.running():
        for _ in range(3):
            bench.link.post(b"urgent")
            await anyio.wait_all_tasks_blocked()
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert bench.channel.sent == [[b"urgent"], [b"urgent", b"urgent"]]


async def test_who_posts_more_than_is_ever_read_ends_the_connection() -> None:
    bench = Bench(high_water=10)
    bench.channel.is_stuck = True
    async with bench.running():
        for _ in range(20):
            bench.link.post(b"urgent")
        assert not bench.link.is_open
    assert bench.link._queued <= 200


async def test_all_who_wait_for_room_are_told_of_the_end() -> None:
    bench = Bench(high_water=1)
    bench.channel.is_stuck = True
    waiters = [Waiter(lambda: bench.link.send(b"late")) for _ in range(2)]
    waiters.append(Waiter(bench.link.flush))
    async with bench.running(), anyio.create_task_group() as tasks:
        bench.link.post(b"stuck")
        for waiter in waiters:
            tasks.start_soon(waiter)
        await anyio.wait_all_tasks_blocked()
        assert not any(waiter.is_done for waiter in waiters)
        bench.link.end(ProtocolError("nonsense"))
    assert all(waiter.is_done for waiter in waiters)
    assert [str(waiter.error) for waiter in waiters] == ["nonsense", "nonsense", "None"]
    assert bench.channel.sent == []


async def test_flush_waits_until_all_is_written() -> None:
    bench = Bench()
    bench.channel.is_stuck = True
    flusher = Waiter(bench.link.flush)
    async with bench.running(), anyio.create_task_group() as tasks:
        bench.link.post(b"one")
        await anyio.wait_all_tasks_blocked()
        bench.link.post(b"two")
        tasks.start_soon(flusher)
        await anyio.wait_all_tasks_blocked()
        assert not flusher.is_done
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert flusher.is_done
        assert bench.channel.sent == [[b"one"], [b"two"]]


async def test_flush_waits_for_what_is_being_written() -> None:
    bench = Bench()
    bench.channel.is_stuck = True
    flusher = Waiter(bench.link.flush)
    async with bench.running(), anyio.create_task_group() as tasks:
        bench.link.post(b"one")
        await anyio.wait_all_tasks_blocked()
        tasks.start_soon(flusher)
        await anyio.wait_all_tasks_blocked()
        assert not flusher.is_done
        bench.channel.unstick()
        await anyio.wait_all_tasks_blocked()
        assert flusher.is_done


async def test_flush_does_not_wait_for_nothing() -> None:
    bench = Bench()
    async with bench.running():
        await bench.link.flush()


# What arrives


async def test_messages_are_handled_in_the_order_in_which_they_arrive() -> None:
    bench = Bench()
    async with bench.running():
        bench.channel.arrive(b"one", b"two")
        await anyio.wait_all_tasks_blocked()
        bench.channel.arrive(b"three")
        await anyio.wait_all_tasks_blocked()
        assert bench.handled == [b"one", b"two", b"three"]


async def test_messages_are_handled_while_a_write_is_stuck() -> None:
    bench = Bench()
    bench.channel.is_stuck = True
    async with bench.running():
        bench.link.post(b"stuck")
        bench.channel.arrive(b"one")
        await anyio.wait_all_tasks_blocked()
        assert bench.handled == [b"one"]


# How it ends


async def test_an_error_of_who_handles_ends_it_for_that_reason() -> None:
    bench = Bench()
    error = ProtocolError("nonsense")

    def handle(frame: bytes) -> None:
        bench.handle(frame)
        raise error

    bench.channel.arrive(b"one", b"two")
    with anyio.fail_after(5):
        await bench.run(handle)
    assert bench.error is error
    assert bench.handled == [b"one"]
    assert not bench.link.is_open


async def test_what_arrives_behind_the_end_is_not_handled() -> None:
    bench = Bench()

    def handle(frame: bytes) -> None:
        bench.handle(frame)
        bench.link.end(OVER)

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            bench.channel.arrive(b"one", b"two")
            tasks.start_soon(bench.run, handle)
    assert bench.handled == [b"one"]
    assert bench.error is OVER


async def test_what_is_posted_in_the_turn_of_the_end_is_not_begun_to_be_written() -> None:
    bench = Bench()

    def handle(frame: bytes) -> None:
        bench.link.post(b"welcome")
        raise ProtocolError("nonsense")

    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(bench.run, handle)
            await anyio.wait_all_tasks_blocked()
            bench.channel.arrive(b"one")
    assert bench.channel.asked == 0  # half a message would be in the way of the last word


async def test_who_handles_may_end_it() -> None:
    bench = Bench()
    error = ConnectionLost("it left")
    bench.channel.arrive(b"goodbye")
    with anyio.fail_after(5):
        await bench.run(lambda frame: bench.link.end(error))
    assert bench.error is error


async def test_a_connection_that_breaks_while_reading_ends_it() -> None:
    bench = Bench()
    error = ConnectionLost("it broke")
    async with bench.running():
        assert bench.link.is_open
        bench.channel.fail(error)
        await anyio.wait_all_tasks_blocked()
    assert bench.error is error


async def test_a_connection_that_breaks_while_writing_ends_it() -> None:
    bench = Bench()
    error = ConnectionLost("it broke")
    async with bench.running():
        bench.channel.error = error  # without a word to who reads
        bench.link.post(b"one")
        await anyio.wait_all_tasks_blocked()
    assert bench.error is error


async def test_the_first_reason_to_end_counts() -> None:
    bench = Bench()
    first = AuthenticationFailed("no")
    async with bench.running():
        bench.link.end(first)
        bench.link.end(ConnectionLost("later"))
    assert bench.error is first


async def test_a_link_that_was_ended_before_it_ran_does_not_run() -> None:
    bench = Bench()
    bench.link.post(b"one")
    bench.link.end(OVER)
    bench.channel.is_stuck = True
    with anyio.fail_after(5):
        await bench.run()
    assert bench.error is OVER
    assert bench.channel.sent == []


async def test_what_is_sent_after_the_end_raises_a_new_error_each_time() -> None:
    bench = Bench()
    error = ProtocolError("nonsense")
    bench.link.end(error)
    raised = []
    for _ in range(2):
        with pytest.raises(ConnectionLost, match=r"^nonsense$") as caught:
            await bench.link.send(b"late")
        assert caught.value.__cause__ is error
        raised.append(caught.value)
    assert raised[0] is not raised[1]


async def test_what_is_posted_after_the_end_is_lost() -> None:
    bench = Bench()
    async with bench.running():
        pass
    bench.link.post(b"late")
    with anyio.fail_after(5):
        await bench.link.flush()
    assert bench.channel.sent == []


async def test_an_error_of_the_program_is_not_taken_for_one_of_the_connection() -> None:
    bench = Bench()

    def handle(frame: bytes) -> None:
        raise LookupError("a bug")

    bench.channel.arrive(b"one")
    with anyio.fail_after(5), pytest.raises(ExceptionGroup) as caught:
        await bench.run(handle)
    assert caught.group_contains(LookupError, match=r"^a bug$")


async def test_who_runs_it_can_be_canceled() -> None:
    bench = Bench()
    with anyio.fail_after(5):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(bench.run)
            await anyio.wait_all_tasks_blocked()
            tasks.cancel_scope.cancel()
    assert bench.error is None


# The last word


async def test_the_last_word_goes_past_the_queue() -> None:
    bench = Bench()
    bench.link.end(OVER)
    bench.link.post(b"late")
    await bench.link.say_last(b"goodbye")
    assert bench.channel.sent == [[b"goodbye"]]


@in_virtual_time()
async def test_the_last_word_is_given_up_after_a_second() -> None:
    bench = Bench()
    bench.channel.is_stuck = True
    start = anyio.current_time()
    await bench.link.say_last(b"goodbye")
    assert anyio.current_time() - start == 1
    assert bench.channel.sent == []


async def test_a_last_word_that_nobody_hears_is_no_error() -> None:
    bench = Bench()
    bench.channel.fail(ConnectionLost("it broke"))
    await bench.link.say_last(b"goodbye")
    assert bench.channel.sent == []


# Signs of life


def test_a_sign_of_life_is_one_for_both_sides() -> None:
    assert decode_from_client(PING) == decode_from_server(PING) == Ping()


class Stopwatch(Bench):
    """A link that runs until it ends by itself, or for so many virtual seconds."""

    async def run_for(self, seconds: float, *helpers: Callable[[], Any]) -> float:
        start = anyio.current_time()
        with anyio.move_on_after(seconds):
            async with anyio.create_task_group() as tasks:
                for helper in helpers:
                    tasks.start_soon(helper)
                await self.run()
                tasks.cancel_scope.cancel()
        return anyio.current_time() - start

    async def hear_from_the_peer(self, pause: float) -> None:
        while True:
            self.channel.arrive(b"alive")
            await anyio.sleep(pause)


@in_virtual_time()
async def test_a_silent_peer_is_noticed_after_four_of_its_heartbeats() -> None:
    bench = Stopwatch(heartbeat=2)
    took = await bench.run_for(100)
    assert 4 * 2 < took <= 4 * 2 + 2
    assert isinstance(bench.error, ConnectionLost)
    # It does not count the half heartbeat in which it began: the peer may have spoken before that.
    assert str(bench.error) == f"{PEER} has been silent for {took - 1:.1f} s"


@in_virtual_time()
@pytest.mark.parametrize(("own", "peers"), [(1.0, 10.0), (3.0, 0.1)])
async def test_it_is_the_peers_heartbeat_that_counts(own: float, peers: float) -> None:
    bench = Stopwatch(heartbeat=own)
    assert bench.link.heartbeat.peer_interval == own
    bench.link.heartbeat.peer_interval = peers
    took = await bench.run_for(100)
    assert MISSED * peers < took <= MISSED * peers + min(own, peers)
    assert isinstance(bench.error, ConnectionLost)


@in_virtual_time()
async def test_a_peer_that_is_late_is_not_lost() -> None:
    bench = Stopwatch(heartbeat=1)
    assert await bench.run_for(100, lambda: bench.hear_from_the_peer(3.5)) == 100
    assert bench.error is None
    assert len(bench.handled) == 29


@in_virtual_time()
async def test_silence_counts_from_the_last_message() -> None:
    bench = Stopwatch(heartbeat=1)

    async def speak_once() -> None:
        await anyio.sleep(3.5)
        bench.channel.arrive(b"alive")

    assert 3.5 + 4 < await bench.run_for(100, speak_once) <= 3.5 + 5


@in_virtual_time()
async def test_a_peer_that_reads_nothing_is_lost_after_four_of_ones_own_heartbeats() -> None:
    bench = Stopwatch(heartbeat=2)
    bench.link.heartbeat.peer_interval = 1000
    bench.channel.is_stuck = True
    took = await bench.run_for(100, lambda: bench.hear_from_the_peer(1))
    # The first ping is what gets stuck.
    assert 4 * 2 < took <= 4 * 2 + 2 + 2
    assert isinstance(bench.error, ConnectionLost)
    assert str(bench.error) == f"{PEER} has read nothing for 9.0 s"


@in_virtual_time()
@pytest.mark.parametrize(("pause", "is_lost"), [(0.5, False), (3.9, False), (5.1, True)])
async def test_a_peer_that_takes_a_piece_now_and_then_is_not_lost(
    pause: float, is_lost: bool
) -> None:
    bench = Stopwatch(heartbeat=1)
    bench.channel.is_stuck = True
    bench.link.post(bytes(2**20))

    async def take_a_piece() -> None:
        while True:
            await anyio.sleep(pause)
            bench.channel.pieces += 1

    took = await bench.run_for(100, lambda: bench.hear_from_the_peer(1), take_a_piece)
    assert (took < 100) == is_lost
    assert (bench.error is not None) == is_lost


@in_virtual_time()
async def test_a_peer_that_takes_one_message_after_the_other_is_not_lost() -> None:
    bench = Stopwatch(heartbeat=1)
    Spring(bench).left = [[b"news"] for _ in range(1000)]
    bench.channel.pause = 0.3
    bench.link.wake_writer()
    await bench.run_for(100, lambda: bench.hear_from_the_peer(1))
    assert bench.error is None
    assert len(bench.channel.sent) > 300


@in_virtual_time()
async def test_time_in_which_this_process_does_not_run_is_not_the_peers_silence() -> None:
    bench = Stopwatch(heartbeat=1)

    async def stop_the_process() -> None:
        await anyio.sleep(10.2)
        clock = trio.lowlevel.current_clock()
        assert isinstance(clock, MockClock)
        clock.jump(1000)

    await bench.run_for(2000, lambda: bench.hear_from_the_peer(0.9), stop_the_process)
    assert bench.error is None


@in_virtual_time()
async def test_pings_are_sent_when_there_is_nothing_else_to_say() -> None:
    bench = Stopwatch(heartbeat=2)
    await bench.run_for(11, lambda: bench.hear_from_the_peer(1))
    assert bench.channel.sent == [[PING]] * 5
    gaps = [late - early for early, late in pairwise(bench.channel.times)]
    assert gaps == [2] * 4


@in_virtual_time()
async def test_no_more_pings_are_sent_because_the_peer_sends_many() -> None:
    bench = Stopwatch(heartbeat=2)
    bench.link.heartbeat.peer_interval = 0.125
    await bench.run_for(11, lambda: bench.hear_from_the_peer(0.0625))
    gaps = [late - early for early, late in pairwise(bench.channel.times)]
    assert bench.error is None
    assert len(gaps) >= 8
    assert min(gaps) >= 1


@in_virtual_time()
async def test_no_pings_are_sent_while_there_is_something_to_say() -> None:
    bench = Stopwatch(heartbeat=2)

    async def speak() -> None:
        while True:
            bench.link.post(b"news")
            await anyio.sleep(0.75)

    await bench.run_for(50, lambda: bench.hear_from_the_peer(1), speak)
    assert len(bench.channel.sent) > 60
    assert {tuple(frames) for frames in bench.channel.sent} == {(b"news",)}


@in_virtual_time()
@pytest.mark.parametrize("pause", [0.9, 1.0, 1.1, 1.5, 1.9, 2.0, 2.1, 3.3])
async def test_a_peer_hears_something_often_enough_whatever_else_is_said(pause: float) -> None:
    bench = Stopwatch(heartbeat=1)

    async def speak() -> None:
        while True:
            bench.link.post(b"news")
            await anyio.sleep(pause)

    await bench.run_for(60, lambda: bench.hear_from_the_peer(1), speak)
    times = bench.channel.times
    assert times[-1] - times[0] > 55
    assert max(late - early for early, late in pairwise(times)) <= 2


class TricklingStream(ByteStream):
    """Gives one byte of a large message each second."""

    def __init__(self, data: bytes) -> None:
        self._left = data

    async def receive(self, max_bytes: int = 65536) -> bytes:
        if not self._left:
            await anyio.sleep_forever()
        await anyio.sleep(1)
        byte, self._left = self._left[:1], self._left[1:]
        return byte

    async def send(self, item: bytes) -> None:
        pass

    async def send_eof(self) -> None:
        raise NotImplementedError

    async def aclose(self) -> None:
        raise NotImplementedError


@in_virtual_time()
async def test_a_peer_in_the_middle_of_a_large_message_is_not_silent() -> None:
    large = bytes(20)
    stream = TricklingStream(header(len(large)) + large)
    link = Link(StreamChannel(stream, PEER, 1000), heartbeat=1)
    handled: list[bytes] = []

    def handle(frame: bytes) -> None:
        handled.append(frame)
        link.end(OVER)

    assert str(await link.run(handle)) == str(OVER)
    assert handled == [large]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("10.0.0.1:7400 closed its side", "10.0.0.1:7400 closed its side"),
        ("the connection to 10.0.0.1:7400 broke", "the connection to 10.0.0.1:7400 broke"),
        ("it said hello twice", "10.0.0.1:7400: it said hello twice"),
    ],
)
async def test_the_line_of_the_log_about_an_end_names_the_peer_once(text: str, line: str) -> None:
    assert naming("10.0.0.1:7400", ConnectionLost(text)) == line
