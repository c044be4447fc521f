"""How much each end takes: credit, limits, slow readers, the size of messages, and heartbeats."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import AsyncGenerator, Callable
from contextlib import suppress
from itertools import pairwise
from typing import Any

import anyio
import anyio.lowlevel
import pytest
import trio
from anyio.abc import ByteStream
from trio.testing import MockClock

from fibaction.border.abc import GoalRequest
from fibaction.border.event_loop import SLICE
from fibaction.feeds import feedback_window
from fibaction.server import ActionServer, GoalHandle
from fibaction.testing import ScriptedServer
from fibaction.wire.channel import CHUNK, Line, NextFrames, OnFrames, StreamChannel
from fibaction.wire.frames import (
    FIRST_FRAME,
    LEAST_FRAME,
    MAX_FRAME,
    UNCOUNTED,
    FrameReader,
    header,
)
from fibaction.wire.link import Link
from fibaction.wire.messages import (
    VERSION,
    Actions,
    AwaitServer,
    CancelAnswered,
    CancelGoals,
    Close,
    Credit,
    Ended,
    Failed,
    Feedback,
    Follow,
    Following,
    GoalChanged,
    Goodbye,
    Hello,
    ListActions,
    Ping,
    Received,
    Rejected,
    SendGoal,
    StatusChanged,
    Welcome,
    Why,
    decode_from_server,
    encode,
)
from fibaction.wire.server.subscriptions import PIECE
from fibaction.wire.settings import ClientSettings, Limits
from fibaction.words.errors import (
    ConnectionLost,
    GoalRejected,
    InvalidMessage,
    ProtocolError,
    RejectionCode,
    ServerNotFound,
)
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from tests.support import fibonacci as fib
from tests.support.fibonacci import FIBONACCI
from tests.support.matching import Like
from tests.support.slices import SliceClock
from tests.support.virtual_time import in_virtual_time
from tests.wire import memory
from tests.wire.ends import (
    ANN,
    ANY,
    BOB,
    EXECUTING,
    GOAL,
    GOAL_ID,
    SUCCEEDED,
    WHERE,
    WINDOW,
    A,
    B,
    C,
    Client,
    Network,
    Served,
    endpoint_of,
    feedback,
    goal_of,
    held,
    is_used,
    kinds,
    outcome_of,
    reached,
    running,
    scripted,
    send,
    serving,
    watched,
)
from tests.wire.memory import LONG, Peer, Running, logged, settled

pytestmark = pytest.mark.anyio


# The credit that a client gives


async def test_a_status_comes_without_credit() -> None:
    async with serving(scripted(*feedback(1, 2), anyio.Event())) as served:
        client = await served.greet()
        await client.send(1, credit=1)
        assert (await client.hear(Feedback)).number == 1
        await client.say(CancelGoals(2, "fibonacci", A, None))
        heard = await client.hear_by_id()
        assert heard[1] == [StatusChanged(1, GoalStatus.CANCELING)]


# The size of the messages that a client takes

LARGE = fib.Result([0] * 2000)


def like_ended(request: int, result: fib.Result, place: int = 0) -> Like:
    return Like(Ended(request, SUCCEEDED, FIBONACCI.result.encode(result), "", place))


async def test_a_result_over_the_clients_limit_fails_that_goal_and_is_not_kept() -> None:
    go = anyio.Event()
    server = ScriptedServer(FIBONACCI, [*feedback(1), go, LARGE], [go, fib.Result([])])
    async with serving(server, limits=Limits(goals=2)) as served:
        client = await served.greet(max_frame=LEAST_FRAME)
        await client.send(1, A)
        await client.hear(Feedback)
        await client.send(2, B)
        with logged() as lines:
            go.set()
            heard = await client.hear_by_id()
        (failed,) = heard.pop(1)
        assert isinstance(failed, Failed)
        text = failed.text
        assert re.fullmatch(
            r"the answer has \d+ bytes, and the client accepts 1024: connect.*limits=.*", text
        )
        assert (failed.why, heard) == (Why.LIMIT, {2: [like_ended(2, fib.Result([]))]})
        assert [line.getMessage() for line in lines] == [f"an answer is not sent: {text}"]
        await client.send(1, C)


async def test_feedback_over_the_clients_limit_is_left_out_and_costs_no_credit() -> None:
    large = fib.Feedback([0] * 2000)
    server = running(*feedback(1), large, *feedback(3), large, fib.Result([]))
    async with serving(server) as served:
        client = await served.greet(max_frame=LEAST_FRAME)
        with logged() as lines:
            await client.send(1, credit=2)
            assert [message.number for message in await client.hear_all()] == [1, 3]
            await client.say(Credit(1, 1))  # it takes credit to find out that the next is too large
            assert await client.hear_all() == [like_ended(1, fib.Result([]), 4)]
        limit = "its client takes messages of 1024 bytes at most"
        text = f"feedback of goal {A.hex()} is left out: {limit}"
        assert [(line.levelno, line.getMessage()) for line in lines] == [(logging.WARNING, text)]


LONG_TEXT = "größer" * 300


@pytest.mark.parametrize("error", [GoalRejected, ServerNotFound])
@pytest.mark.parametrize("limit", [*range(LEAST_FRAME, LEAST_FRAME + 4), 1300])
async def test_an_error_is_cut_to_the_clients_limit_between_two_letters(
    error: Callable[[str], Exception], limit: int
) -> None:
    class Failing(ActionServer[fib.Goal, fib.Feedback, fib.Result]):
        def offer_goal(self, request: GoalRequest) -> Any:
            raise error(LONG_TEXT)

    async with serving(Failing(FIBONACCI, fib.fibonacci)) as served:
        client = await served.greet(max_frame=limit)
        answer = await client.ask(send(1), Rejected if error is GoalRejected else Failed)
        assert limit - 6 <= len(encode(answer)) <= limit
        text = getattr(answer, "reason", None) or getattr(answer, "text", "")
        assert text
        assert LONG_TEXT.startswith(text)


# Turns


def endless(window: int) -> tuple[ActionServer[Any, Any, Any], list[int]]:
    """A server whose goals give feedback without an end if they are of any order, and a count."""
    count = [0]

    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        while goal.request.order:
            yield fib.Feedback([0] * 1000)  # a piece of it fills a write
            count[0] += 1
        yield fib.Result([])

    return ActionServer(FIBONACCI, executor, feedback_window=window), count


async def test_a_goal_with_endless_feedback_delays_neither_another_nor_an_answer() -> None:
    server, _ = endless(1000)
    async with serving(server) as served:
        client = await served.greet()
        client.channel.stop_reading()
        await client.say(send(1))
        await settled()
        few = FIBONACCI.goal.encode(fib.Goal(0))
        await client.say(SendGoal(2, "fibonacci", B, few, ANY), ListActions(3))
        await settled()
        client.channel.go_on_reading()
        before: dict[int, int] = {}
        heard = 0
        with anyio.fail_after(5):
            while 2 not in before:
                message = await client.hear(object)
                if isinstance(message, Feedback):
                    heard += 1
                elif isinstance(message, Ended | Actions):
                    before[message.id] = heard
        # One piece before each message of the other goal, and what was on its way before.
        assert PIECE < before[2] <= 6 * PIECE
        assert before[3] <= 2 * PIECE


async def test_messages_that_there_are_at_once_are_one_write() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        before = len(client.channel.writes)
        await client.say(*(AwaitServer(number, "fibonacci") for number in range(10)))
        assert len(await client.hear_all()) == 10
        assert len(client.channel.writes) == before + 1


# The limits of a server


@pytest.mark.parametrize(
    "message", [AwaitServer(1, "fibonacci"), ListActions(1), send(1)], ids=type
)
async def test_an_id_that_is_in_use_ends_the_session(message: Any) -> None:
    async with serving(held()) as served:
        client = await served.greet()
        await client.send(1)
        goodbye = await client.ask(message, Goodbye)
        text = "the server has closed the connection: it used the ID 1 twice"
        assert goodbye == Goodbye(text, Why.PROTOCOL)
        await client.hear_the_end()


async def test_no_more_goals_are_taken_than_the_limit_and_more_once_one_has_ended() -> None:
    async with serving(held(), limits=Limits(goals=1, requests=7)) as served:
        client, other = await served.greet(ANN), await served.greet(BOB)
        await client.send(1, A)
        text = "too much at once: the limits of a connection are 1 goals and 7 other requests"
        assert await client.ask(send(2, B), Rejected) == Rejected(2, text, RejectionCode.BUSY)
        failed = await client.ask(Follow(3, "fibonacci", B, None, False, 1), Failed)
        assert failed == Failed(3, Why.LIMIT, text)
        await other.send(1, B)
        await client.say(CancelGoals(4, "fibonacci", A, None))
        heard = await client.hear_by_id()
        assert (kinds(heard[4]), kinds(heard[1])) == ([CancelAnswered], [StatusChanged, Ended])
        # It is kept for a client that has not said that it knows.
        await client.ask(send(5, C), Rejected)
        await client.say(Received(1))
        await client.send(5, C)


async def test_no_more_requests_are_taken_than_the_limit() -> None:
    async with serving(limits=Limits(requests=2)) as served:
        served.endpoints["fibonacci"] = held()
        client = await served.greet()
        await client.say(*(AwaitServer(i, "fibonacci") for i in range(1, 5)))
        heard = await client.hear_all()
        assert [(type(message), message.id, message.why) for message in heard] == [
            (Failed, 3, Why.LIMIT),
            (Failed, 4, Why.LIMIT),
        ]
        await client.say(Close(1))
        await settled()
        await client.say(AwaitServer(3, "fibonacci"))
        assert await client.hear_all() == []


async def test_the_meta_of_goals_that_are_decided_upon_takes_memory() -> None:
    async def on_goal(goal: fib.Goal) -> None:
        await anyio.sleep_forever()

    server = ActionServer(FIBONACCI, fib.fibonacci, on_goal=on_goal)
    async with serving(server, limits=Limits(memory=len(GOAL) + 10)) as served:
        client = await served.greet()
        goals = [
            SendGoal(request, "fibonacci", goal_id, GOAL, None, None, {"a": "x" * size})
            for request, goal_id, size in ((1, A, 10), (2, B, 9))
        ]
        rejected = await client.ask(goals[0], Rejected)
        assert rejected.reason.startswith("too many bytes at once")
        assert await client.ask_all(goals[1]) == []


# Clients that do not read


@in_virtual_time()
@pytest.mark.parametrize("requests", [1, 1000], ids=["over the limit", "unknown goals"])
async def test_a_client_that_asks_and_does_not_read_fills_no_memory(requests: int) -> None:
    limits = Limits(requests=requests, queue=10_000)
    size = len(encode(Failed(1, Why.UNKNOWN_GOAL, f"there is no goal {GoalID(B)}")))
    async with serving(held(), limits=limits) as served:
        client = await served.greet(name="the greedy one")
        client.channel.stop_reading()
        said = 0
        with logged() as lines, suppress(ConnectionLost):
            while True:
                await client.say(Follow(said, "fibonacci", B, None, False, 1))
                said += 1
                await anyio.sleep(0.01)
        await settled()
        assert said <= 2 * 10_000 / size + 101  # those of the second that the last word may take
        assert [(line.levelno, line.getMessage()) for line in lines] == [
            (logging.WARNING, "the greedy one asks for more than it reads")
        ]


async def test_answers_wait_for_a_client_that_does_not_read_and_do_not_end_its_connection() -> None:
    async with serving(held(), limits=Limits(queue=100)) as served:
        client, lost = await served.greet(ANN), await served.greet(BOB)
        await settled()
        before = len(anyio.get_running_tasks())
        for one in (client, lost):
            one.channel.stop_reading()
            await one.say(*(ListActions(number) for number in range(50)))
        await settled()
        assert len(anyio.get_running_tasks()) <= before + 2  # one for all of a client
        await client.say(send(50, credit=None))
        await settled()
        with logged() as lines:
            lost.channel.cut()
            await settled()
        assert [line.levelno for line in lines] == [logging.INFO]
        client.channel.go_on_reading()
        heard = await client.hear_all()
        assert [one.id for one in heard if isinstance(one, Actions)] == [*range(50)]
        assert kinds(heard).count(Following) == 1


async def test_an_executor_waits_for_moments_only_where_the_line_holds_it_briefly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Line, "holds_briefly", True)
    monkeypatch.setattr(feedback_window, "LONGEST_HOLD", 0.01)
    done = anyio.Event()

    async def counted(goal: GoalHandle[fib.Goal]) -> AsyncGenerator[fib.Feedback | fib.Result]:
        async for item in fib.fibonacci(goal):
            if isinstance(item, fib.Result):
                done.set()
            yield item

    server = ActionServer(FIBONACCI, counted, feedback_window=4)
    async with serving(server) as served:
        client = await served.greet(ANN)
        goal = FIBONACCI.goal.encode(fib.Goal(80))
        await client.say(SendGoal(1, "fibonacci", GOAL_ID, goal, 0))
        with anyio.fail_after(5):
            await done.wait()
        await settled()
        await client.say(Credit(1, 100))
        heard = await client.hear_all()
        numbers = [message.number for message in heard if isinstance(message, Feedback)]
        assert numbers == [76, 77, 78, 79]
        assert kinds(heard)[-1] is Ended


# Heartbeats


async def lost_after(client: Client, *helpers: Callable[[], Any]) -> float:
    """Run helpers until the server ends the connection; return the seconds, 100 if it does not."""
    start = anyio.current_time()
    with anyio.move_on_after(100):
        async with anyio.create_task_group() as tasks:
            for helper in helpers:
                tasks.start_soon(helper)
            await client.channel.cut_off()
            tasks.cancel_scope.cancel()
    return anyio.current_time() - start


def every(pause: float, function: Callable[[], Any]) -> Callable[[], Any]:
    async def repeat() -> None:
        while True:
            await anyio.sleep(pause)
            if (waited := function()) is not None:
                await waited

    return repeat


def alive(client: Client, pause: float = 1) -> Callable[[], Any]:
    return every(pause, lambda: client.say(Ping()))


@in_virtual_time()
@pytest.mark.parametrize(("own", "peers"), [(2.0, 2.0), (1.0, 10.0), (3.0, 0.1)])
async def test_a_silent_client_is_lost_after_four_of_the_heartbeats_that_it_announced(
    own: float, peers: float
) -> None:
    async with serving(held(), heartbeat=own) as served:
        client = await served.greet(heartbeat=peers)
        with logged() as lines:
            took = await lost_after(client)
        assert 4 * peers < took <= 5 * peers + max(own, 0.25)
        (line,) = lines
        assert line.getMessage().startswith("the client has been silent for ")
        assert abs(float(line.getMessage().split()[-2]) - took) <= own / 2 + 0.25


@in_virtual_time()
async def test_a_client_that_is_late_is_not_lost() -> None:
    async with serving(held(), heartbeat=1) as served:
        client = await served.greet(heartbeat=1)
        assert await lost_after(client, alive(client, 3.5)) == 100
        # Silence counts from the last message, which was said two seconds before.
        assert 4 < 2 + await lost_after(client) <= 5.5


@in_virtual_time()
async def test_a_client_that_reads_nothing_is_lost_after_four_of_the_servers_heartbeats() -> None:
    async with serving(held(), heartbeat=2) as served:
        client = await served.greet(heartbeat=LONG)
        client.channel.stop_reading()
        with logged() as lines:
            took = await lost_after(client, alive(client))
        assert 4 * 2 < took <= 4 * 2 + 2 + 2  # the first ping is what gets stuck
        assert [line.getMessage() for line in lines] == ["the client has read nothing for 9.0 s"]


@in_virtual_time()
async def test_a_peer_that_does_not_read_what_the_line_says_by_itself_is_lost() -> None:
    here, there = memory.pair()
    here.has_answer = True  # such as pongs: the queue waits behind them
    link = Link(here, 2)
    there.stop_reading()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(every(1, lambda: there.send([encode(Ping())])))
        error = await link.run(lambda _: None)
        tasks.cancel_scope.cancel()
    assert re.fullmatch(r"the (client|server) has read nothing for \d\.\d s", str(error))


@in_virtual_time()
@pytest.mark.parametrize("part", ["a piece", "a message"])
@pytest.mark.parametrize(("pause", "is_lost"), [(0.5, False), (3.9, False), (5.1, True)])
async def test_a_client_that_reads_something_now_and_then_is_not_lost(
    part: str, pause: float, is_lost: bool
) -> None:
    talking = running(*feedback(*range(1000)), fib.Result([]))
    async with serving(talking, heartbeat=1) as served:
        client = await served.greet(heartbeat=1)
        client.channel.stop_reading()
        await client.say(send(1))

        async def read_a_message() -> None:
            client.channel.go_on_reading()
            with suppress(ConnectionLost):
                await client.channel.receive()
            client.channel.stop_reading()

        read: Any = client.channel.take_a_piece if part == "a piece" else read_a_message
        took = await lost_after(client, alive(client), every(pause, read))
        assert (took < 100) == is_lost


@in_virtual_time()
async def test_time_in_which_this_process_does_not_run_is_not_the_clients_silence() -> None:
    async with serving(held(), heartbeat=1) as served:
        client = await served.greet(heartbeat=1)

        async def stop_the_process() -> None:
            await anyio.sleep(10.2)
            clock = trio.lowlevel.current_clock()
            assert isinstance(clock, MockClock)
            clock.jump(80)

        assert await lost_after(client, alive(client, 0.9), stop_the_process) >= 100


def gaps(client: Client) -> list[float]:
    """Seconds between the writes of the server."""
    times = [time for time, _ in client.channel.writes]
    return [late - early for early, late in pairwise(times)]


@in_virtual_time()
@pytest.mark.parametrize("peers", [2, 0.125])
async def test_pings_are_sent_when_there_is_nothing_else_to_say(peers: float) -> None:
    async with serving(held(), heartbeat=2) as served:
        client = await served.greet(heartbeat=peers)
        assert await lost_after(client, alive(client, peers / 2)) == 100
        assert {tuple(frames) for _, frames in client.channel.writes[1:]} == {(encode(Ping()),)}
        assert 1 <= min(gaps(client)[1:]) <= max(gaps(client)) <= 2
        assert len(gaps(client)) >= 49


@in_virtual_time()
@pytest.mark.parametrize("pause", [0.375, 0.9, 1.0, 1.1, 1.5, 1.9, 2.0, 2.1, 3.3])
async def test_a_client_hears_something_often_enough_whatever_else_is_said(pause: float) -> None:
    async def executor(goal: Any) -> AsyncGenerator[fib.Feedback | fib.Result, None]:
        while True:
            await anyio.sleep(pause)
            yield fib.Feedback([])

    async with serving(ActionServer(FIBONACCI, executor), heartbeat=1) as served:
        client = await served.greet(heartbeat=1)
        await client.say(send(1))
        assert await lost_after(client, alive(client)) == 100
        assert max(gaps(client)) <= 2
        if pause < 0.5:
            written = [frame for _, frames in client.channel.writes for frame in frames]
            assert encode(Ping()) not in written


@in_virtual_time()
async def test_the_last_word_to_a_client_that_does_not_read_is_given_up_after_a_second() -> None:
    async with serving(held()) as served:
        client = await served.greet()
        client.channel.stop_reading()
        await client.say(Hello(VERSION, LONG))
        await anyio.sleep(0.9)
        assert not client.channel.is_cut
        await anyio.sleep(0.2)
        assert client.channel.is_cut


async def test_a_link_that_was_ended_before_it_ran_does_not_run() -> None:
    end, other = memory.pair()
    link, error = Link(end, LONG), ConnectionLost("never mind")
    link.post(b"one")
    link.end(error)
    link.end(ConnectionLost("later"))  # the first reason counts
    assert await link.run(lambda frame: None) is error
    assert other.writes == []


@in_virtual_time()
async def test_a_client_in_the_middle_of_a_message_is_not_silent() -> None:
    hello = encode(Hello(VERSION, 1, session=bytes(32)))
    data = header(len(hello)) + hello
    async with serving(held(), heartbeat=1, limits=Limits(handshake=1000)) as served:
        stream = fed(served)
        with logged() as lines:
            for byte in data:
                await stream.give(bytes([byte]))
                await anyio.sleep(1)
            await anyio.sleep(2.9)
            assert lines == []
            await anyio.sleep(2)
        assert lines[0].getMessage().startswith("the fed one has been silent for ")


class FeedStream(ByteStream):
    """Gives the bytes that a test hands over, and keeps what the server sends."""

    def __init__(self) -> None:
        self.sent = bytearray()
        self._send, self._receive = anyio.create_memory_object_stream[bytes](math.inf)

    async def give(self, *pieces: bytes) -> None:
        for piece in pieces:
            await self._send.send(piece)
        await settled()

    def end(self) -> None:
        self._send.close()

    async def receive(self, max_bytes: int = 65536) -> bytes:
        return await self._receive.receive()

    async def send(self, item: bytes) -> None:
        self.sent += item

    async def send_eof(self) -> None:
        raise NotImplementedError

    async def aclose(self) -> None:
        self._receive.close()
        self.end()

    @property
    def heard(self) -> list[Any]:
        """The messages that the server has sent."""
        return [decode_from_server(frame) for frame in FrameReader().feed(bytes(self.sent))]


def fed(served: Served) -> FeedStream:
    """A client whose bytes a test makes."""
    stream = FeedStream()
    served.serve(StreamChannel(stream, "the fed one", served.wire.new_reader()))
    return stream


async def test_before_a_client_is_known_little_is_held_of_it_and_then_a_message_at_most() -> None:
    hello = encode(Hello(VERSION, LONG))
    async with serving(held(), limits=Limits(frame=10_000)) as served:
        for limit, said in ((FIRST_FRAME, b""), (10_000, header(len(hello)) + hello)):
            stream = fed(served)
            await stream.give(said + header(limit + 1))
            last = stream.heard[-1]
            assert last.why == Why.PROTOCOL
            assert f"frame of {limit + 1} bytes exceeds the limit of {limit} bytes" in last.reason
        client = served.connect()
        await client.say(Hello(VERSION, LONG, "x" * FIRST_FRAME))
        last = await client.hear(Goodbye)
        assert last.why == Why.PROTOCOL
        assert last.reason.endswith("bytes, but at most 4096 are allowed")


async def test_the_parts_of_large_messages_share_a_limit_over_all_connections() -> None:
    hello = encode(Hello(VERSION, LONG))
    limits = Limits(total_memory=2 * UNCOUNTED, frame=MAX_FRAME)
    async with serving(held(), limits=limits) as served:
        one, other = fed(served), fed(served)
        for stream in (one, other):
            await stream.give(header(len(hello)) + hello, header(MAX_FRAME))
        piece = bytes(UNCOUNTED)
        await one.give(piece, piece)
        assert served.wire.memory.used > UNCOUNTED
        client = await served.greet()  # a small message passes
        await client.send(1)
        with logged() as lines:
            await other.give(piece, piece, piece)
        (line,) = lines
        assert line.levelno == logging.WARNING
        assert line.getMessage().startswith("the fed one: the server is busy: it has no room")
        assert other.heard[-1].why == Why.LIMIT
        one.end()
        await settled()
        assert served.wire.memory.used == 0
        assert kinds(one.heard) == [Welcome]


async def test_large_messages_that_clients_do_not_take_share_that_limit() -> None:
    go, large = anyio.Event(), fib.Result([0] * 3 * UNCOUNTED)
    limits = Limits(total_memory=5 * UNCOUNTED)  # of two such results, and not of three
    async with serving(scripted(go, large), limits=limits) as served:
        clients = [await served.greet(bytes([number]) * 16) for number in range(1, 4)]
        for number, client in enumerate(clients, 1):
            await client.send(1, bytes([number] * 16), credit=None)
            client.channel.stop_reading()
        go.set()
        await settled()
        lost = [client for client in clients if client.channel.is_cut]
        assert len(lost) == 1
        assert 4 * UNCOUNTED < served.wire.memory.used <= limits.total_memory
        assert await (await served.greet()).is_served()
        for client in clients:
            client.channel.go_on_reading()
        for client in clients:
            assert kinds(await client.hear_all()) == ([] if client in lost else [Ended])
        assert served.wire.memory.used == 0


# What a client keeps of a goal


async def tell(server: Peer, call_id: int, *numbers: int) -> None:
    """Send feedback, and let it arrive."""
    await server.say(*(Feedback(call_id, number, b"%d" % number) for number in numbers))
    await settled()


async def credit_of(server: Peer, call_id: int) -> list[int]:
    """The credit that the client has given, which is all that it has said."""
    heard = await server.hear_all()
    assert heard == [Credit(call_id, message.count) for message in heard]
    return [message.count for message in heard]


def with_window(window: int) -> ClientSettings:
    return ClientSettings(heartbeat=LONG, window=window)


WINDOWS = pytest.mark.parametrize(("window", "batch"), [(2, 1), (3, 2), (4, 2), (5, 3), (8, 4)])


@WINDOWS
async def test_credit_for_statuses_is_given_in_batches_of_half_a_window(
    window: int, batch: int
) -> None:
    """Also if they are not read: a slow reader must not delay the others."""
    async with reached(settings=with_window(window)) as (connection, server):
        _, call_id = await watched(connection, server)
        for count in range(1, window + 1):
            await server.say(GoalChanged(call_id, A, count, EXECUTING, 0))
            assert await credit_of(server, call_id) == [batch] * (count % batch == 0)


@pytest.mark.parametrize("settings", [with_window(1), with_window(2)])
async def test_the_smallest_window_of_a_goal_is_two(settings: ClientSettings) -> None:
    # Of two, one can be dropped for the next.
    async with reached(settings=settings) as (connection, server):
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, b"goal")):
            assert (await server.hear(SendGoal)).credit == 2
            await server.hear_all()


BEYOND: dict[str, tuple[list[int], str]] = {
    "twice": ([1, 2, 2], "feedback 2 came after 2"),
    "backwards": ([2, 1], "feedback 1 came after 2"),
    "from before the place": ([0], "feedback 0 came after 0"),
    "without credit": ([1, 2, 3, 4, 5], "there were more messages than credit for them"),
}


@pytest.mark.parametrize(("numbers", "text"), BEYOND.values(), ids=BEYOND)
async def test_feedback_out_of_order_or_beyond_the_credit_is_the_servers_error(
    numbers: list[int], text: str
) -> None:
    async with reached() as (connection, server):
        async with goal_of(connection, server) as (goal, call_id):
            await tell(server, call_id, *numbers)
            with pytest.raises(ProtocolError, match=f"^{WHERE}: {text}$"):
                await outcome_of(goal)


# The size of the messages that each end takes


async def test_a_message_over_the_servers_limit_is_an_error_of_that_call_only() -> None:
    size = len(encode(SendGoal(1, "fibonacci", GOAL_ID, bytes(10), WINDOW)))
    async with reached(max_frame=size) as (connection, server):
        with anyio.fail_after(5), pytest.raises(InvalidMessage) as caught:
            await endpoint_of(connection).send_goal(GOAL_ID, bytes(40))
        text = (
            f"the message has {size + 30} bytes, and the server accepts {size}:"
            " serve(..., limits=Limits(frame=...)) sets its limit"
        )
        assert str(caught.value) == text
        assert await server.hear_all() == []
        async with Running(lambda: endpoint_of(connection).send_goal(GOAL_ID, bytes(10))):
            assert len(encode(await server.hear(SendGoal))) == size
        await server.hear(Close)
        await is_used(connection, server)


async def test_a_goal_that_the_next_server_does_not_take_is_not_sent_to_it() -> None:
    network = Network()
    async with reached(network) as (connection, server):
        send_goal = endpoint_of(connection).send_goal
        async with Running(lambda: send_goal(GOAL_ID, bytes(2000))) as sending:
            await server.hear(SendGoal)
            server.channel.cut()
            server = await network.accept(max_frame=1000)
            with pytest.raises(InvalidMessage, match="the server accepts 1000: serve"):
                await sending.answer(within=1)


# Turns


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


async def link_over_handed(handle: Callable[[bytes], None], tasks: Any) -> tuple[Handed, Link]:
    line = Handed()
    link = Link(line, LONG)
    tasks.start_soon(link.run, handle)
    await settled()
    return line, link


async def test_the_queue_is_written_in_pieces() -> None:
    async with anyio.create_task_group() as tasks:
        line, link = await link_over_handed(lambda frame: None, tasks)
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
