"""Connections on asyncio, which need no task to read or write."""

from __future__ import annotations

import asyncio  # noqa: TID251  # what is tested is for asyncio only
import gc
import socket
import struct
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import anyio
import anyio.lowlevel
import pytest
from anyio.abc import SocketAttribute

from fibaction.border.event_loop import SLICE
from fibaction.wire.channel import CHUNK, Line
from fibaction.wire.frames import FrameReader, framed
from fibaction.words.errors import ConnectionLost, ProtocolError
from fibaction_transports._socket_lines import on_asyncio, protocol_line
from fibaction_transports._socket_lines.on_asyncio import accept, dial_tcp
from fibaction_transports._socket_lines.protocol_line import PIECE, ProtocolLine
from fibaction_transports._socket_lines.sockets import BATCH
from tests.support.slices import SliceClock

pytestmark = pytest.mark.asyncio

LIMIT = 2**24
RESET = struct.pack("ii", 1, 0)
"""Of SO_LINGER: closing resets the connection."""


@pytest.fixture(autouse=True)
def slice_clock(monkeypatch: pytest.MonkeyPatch) -> SliceClock:
    """Let no slice end, however busy the machine is; tests of slices let the clock advance."""
    clock = SliceClock()
    monkeypatch.setattr(protocol_line, "perf_counter", clock)
    return clock


class End:
    """One end of a connection: what it hears, and what it has to say."""

    def __init__(self, line: Line) -> None:
        assert isinstance(line, ProtocolLine)
        self.line = line
        self.heard: list[bytes] = []
        self.pieces = 0
        """How often something was handed over."""
        self.to_say: list[list[bytes]] = []
        self.fetched = 0
        self.error: Exception | None = None
        self.on_frames: Callable[[list[bytes]], list[bytes] | None] = self.heard.extend
        self._scope = anyio.CancelScope()
        self.ended = anyio.Event()

    def _on_frames(self, frames: list[bytes]) -> list[bytes]:
        self.pieces += 1
        return self.on_frames(frames) or []

    def next_frames(self) -> list[bytes]:
        self.fetched += 1
        return self.to_say.pop(0) if self.to_say else []

    def say(self, *frames: bytes) -> None:
        self.to_say.append(list(frames))
        self.line.wake_writer()

    async def run(self) -> None:
        with self._scope:
            try:
                await self.line.run(self._on_frames, self.next_frames)
            except Exception as exc:
                self.error = exc
        self.ended.set()

    def stop(self) -> None:
        self._scope.cancel()


async def until(condition: Callable[[], object]) -> None:
    """Let the event loop turn until it is so."""
    with anyio.fail_after(30):
        while not condition():
            await anyio.lowlevel.checkpoint()


@asynccontextmanager
async def listening(
    max_frame: int = LIMIT, path: Path | None = None
) -> AsyncGenerator[tuple[Any, list[End]], None]:
    """An address, and the ends of those who have connected to it, which do not run yet."""
    ends: list[End] = []

    async def serve(line: Line) -> None:
        end = End(line)
        ends.append(end)
        try:
            await end.ended.wait()
        finally:
            await line.aclose()

    if path is None:
        listener: Any = await anyio.create_tcp_listener(local_host="127.0.0.1")
    else:
        listener = await anyio.create_unix_listener(path)
    async with listener, anyio.create_task_group() as tasks:
        parts = getattr(listener, "listeners", [listener])
        tasks.start_soon(accept, parts[0], lambda: FrameReader(max_frame), serve, tasks)
        yield listener.extra(SocketAttribute.local_address), ends
        tasks.cancel_scope.cancel()


@asynccontextmanager
async def pair(framing: FrameReader | None = None) -> AsyncGenerator[tuple[End, End], None]:
    """Both ends of a connection, running."""
    async with listening() as ((host, port), ends):
        one = End(await dial_tcp(host, port, framing or FrameReader(), "the server"))
        await until(lambda: ends)
        async with anyio.create_task_group() as tasks:
            for end in (one, ends[0]):
                tasks.start_soon(end.run)
            await until(lambda: one.fetched and ends[0].fetched)
            yield one, ends[0]
            for end in (one, ends[0]):
                end.stop()
        await one.line.aclose()


@asynccontextmanager
async def accepted() -> AsyncGenerator[tuple[End, socket.socket], None]:
    """An end that does not run yet, and a plain socket at the other."""
    async with listening() as (address, ends):
        with socket.create_connection(address) as peer:
            peer.setblocking(False)
            await until(lambda: ends)
            yield ends[0], peer
            ends[0].ended.set()


@asynccontextmanager
async def beside_a_socket() -> AsyncGenerator[tuple[End, socket.socket], None]:
    """An end that is running, and a plain socket at the other."""
    async with accepted() as (end, peer), anyio.create_task_group() as tasks:
        tasks.start_soon(end.run)
        await until(lambda: end.fetched)
        yield end, peer
        end.stop()


async def read(peer: socket.socket, size: int) -> bytes:
    """Read so many bytes from a plain socket."""
    seen = b""
    with anyio.fail_after(30):
        while len(seen) < size:
            await anyio.wait_readable(peer)
            seen += peer.recv(2**20)
    return seen


async def test_what_is_stirred_at_once_is_written_in_the_same_turn() -> None:
    async with pair() as (one, other):
        one.say(b"1")
        one.say(b"2")
        assert len(one.to_say) == 2
        one.line.wake_writer(at_once=True)
        assert one.to_say == []
        await until(lambda: len(other.heard) == 2)
        assert other.heard == [b"1", b"2"]


async def test_who_stirs_at_once_while_it_is_fetched_from_has_to_wait() -> None:
    async with pair() as (one, other):
        next_frames = one.next_frames

        def stirring() -> list[bytes]:
            frames = next_frames()
            if frames:
                one.line.wake_writer(at_once=True)
            return frames

        one.line._next_frames = stirring
        one.to_say = [[b"1"], [b"2"], [b"3"]]
        one.line.wake_writer(at_once=True)
        await until(lambda: len(other.heard) == 3)
        assert other.heard == [b"1", b"2", b"3"]


async def test_after_a_large_write_others_have_their_turn() -> None:
    async with pair() as (one, other):
        turns: list[int] = []
        next_frames = one.next_frames

        def noting() -> list[bytes]:
            turns.append(turn)
            return next_frames()

        one.line._next_frames = noting
        one.to_say = [[bytes(CHUNK)], [b"1"], [bytes(CHUNK)]]
        turn = 0
        one.line.wake_writer()
        with anyio.fail_after(30):
            while len(other.heard) < 3:
                await anyio.lowlevel.checkpoint()
                turn += 1
        assert len(set(turns)) >= 3
        assert len(turns) == 4


async def test_who_does_not_read_stops_the_writing_and_who_reads_again_is_progress() -> None:
    async with beside_a_socket() as (end, peer):
        large = bytes(2**22)
        end.say(large)
        end.say(b"behind it")
        await until(lambda: end.fetched == 2)
        for _ in range(5):
            await anyio.lowlevel.checkpoint()
        assert end.to_say == [[b"behind it"]]
        before = end.line.progress
        assert 0 <= before < len(large)
        seen = b""
        wanted = framed([large, b"behind it"])
        with anyio.fail_after(5):
            while len(seen) < len(wanted):
                await anyio.wait_readable(peer)
                seen += peer.recv(2**20)
                assert end.line.progress >= before
                before = end.line.progress
        assert seen == wanted
        assert end.line.progress == len(wanted)


async def test_of_a_large_message_the_socket_holds_a_piece_only() -> None:
    async with beside_a_socket() as (end, peer):
        end.say(bytes(2**24 - 4))
        await until(lambda: end.line._is_full)
        assert 0 < end.line._transport.get_write_buffer_size() <= PIECE
        await read(peer, 2**24)
        assert end.line._unsent.obj == b""  # the message itself is not held any longer


class Parting(FrameReader):
    """A form that has a goodbye, and expects none of the peer."""

    def goodbye(self) -> bytes:
        return framed([b"last"])


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("closes", [False, True], ids=["send", "aclose"])
async def test_the_last_word_comes_after_the_whole_of_a_large_message(closes: bool) -> None:
    large = bytes(2**22)
    async with accepted() as (end, peer):
        end.line.begin(Parting(), b"")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(end.line.run, end._on_frames, end.next_frames)
            await until(lambda: end.fetched)
            end.say(large)
            await until(lambda: end.line._is_full)
            tasks.cancel_scope.cancel()
        wanted = framed([large, b"last"])
        async with anyio.create_task_group() as tasks:
            if closes:
                tasks.start_soon(end.line.aclose)
            else:
                tasks.start_soon(end.line.send, [b"last"])
            assert await read(peer, len(wanted)) == wanted


def giving_back(end: End, most: int = 1) -> None:
    """Let an end handle so many frames at once, and give the others back."""

    def on_frames(frames: list[bytes]) -> list[bytes]:
        end.heard += frames[:most]
        return frames[most:]

    end.on_frames = on_frames


async def test_frames_that_are_given_back_come_again_one_turn_later_and_nothing_is_read() -> None:
    async with beside_a_socket() as (end, peer):
        giving_back(end)
        peer.send(framed([b"1", b"2", b"3"]))
        await until(lambda: end.heard)
        peer.send(framed([b"4"]))
        for handled in (1, 2, 3):
            assert end.pieces == len(end.heard) == handled
            assert end.line._transport.is_reading() == (handled == 3)
            await anyio.lowlevel.checkpoint()
        await until(lambda: len(end.heard) == 4)
        assert end.heard == [b"1", b"2", b"3", b"4"]


async def test_lines_with_frames_left_share_a_slice_of_each_turn_of_the_loop(
    slice_clock: SliceClock,
) -> None:
    slice_clock.step = 1.0  # more than a slice
    async with listening() as (address, ends):
        peers = [socket.create_connection(address) for _ in range(3)]
        await until(lambda: len(ends) == 3)
        async with anyio.create_task_group() as tasks:
            for end, peer in zip(ends, peers, strict=True):
                giving_back(end)
                peer.send(framed([b"1", b"2", b"3"]))
                tasks.start_soon(end.run)
            await until(lambda: all(end.heard for end in ends))
            while (handled := sum(end.pieces for end in ends)) < 9:
                await anyio.lowlevel.checkpoint()
                assert sum(end.pieces for end in ends) <= handled + 1
                assert max(end.pieces for end in ends) - min(end.pieces for end in ends) <= 1
            tasks.cancel_scope.cancel()
        for peer in peers:
            peer.close()


async def test_of_many_lines_with_news_in_one_turn_the_later_ones_handle_one_frame_each(
    slice_clock: SliceClock,
) -> None:
    slice_clock.step = 1.0  # more than a slice
    async with listening() as (address, ends), anyio.create_task_group() as tasks:
        peers = [socket.create_connection(address) for _ in range(3)]
        await until(lambda: len(ends) == 3)
        for end in ends:
            tasks.start_soon(end.run)
        for numbers in (b"123", b"456"):
            await until(lambda: all(end.line._transport.is_reading() for end in ends))
            for peer in peers:
                peer.send(framed(bytes([number]) for number in numbers))
            before = len(ends[0].heard)
            await until(lambda before=before: any(len(end.heard) > before for end in ends))  # type: ignore[misc]  # bound here, for now
            assert sorted(len(end.heard) - before for end in ends) == [1, 1, 3]
            await until(lambda before=before: all(len(end.heard) == before + 3 for end in ends))  # type: ignore[misc]  # as above
        assert all(b"".join(end.heard) == b"123456" for end in ends)
        tasks.cancel_scope.cancel()
    for peer in peers:
        peer.close()


async def test_lines_that_have_ended_take_no_turn_of_the_others(
    slice_clock: SliceClock,
) -> None:
    slice_clock.step = 1.0  # more than a slice
    async with listening() as (address, ends):
        peers = [socket.create_connection(address) for _ in range(20)]
        await until(lambda: len(ends) == 20)
        async with anyio.create_task_group() as tasks:
            for end, peer in zip(ends, peers, strict=True):
                giving_back(end)
                peer.send(framed([b"1", b"2", b"3", b"4"]))
                tasks.start_soon(end.run)
            await until(lambda: all(end.heard for end in ends))
            *lost, last = ends
            for end in lost:
                end.line.connection_lost(None)
            for _ in range(4):
                await anyio.lowlevel.checkpoint()
            assert len(last.heard) == 4
            tasks.cancel_scope.cancel()
        for peer in peers:
            peer.close()


async def test_frames_that_arrived_before_it_runs_may_be_given_back_as_well() -> None:
    async with listening() as (address, ends):
        with socket.create_connection(address) as peer:
            peer.send(framed([b"1", b"2"]))
            await until(lambda: ends and ends[0].line._early)
            end = ends[0]
            giving_back(end)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(end.run)
                await until(lambda: len(end.heard) == 2)
                peer.send(framed([b"3"]))
                await until(lambda: len(end.heard) == 3)
                end.stop()


async def test_writing_ends_after_a_slice_of_time(slice_clock: SliceClock) -> None:
    async with pair() as (one, other):
        slice_clock.step = SLICE / 2
        one.to_say = [[b"%d" % number] for number in range(6)]
        one.line.wake_writer(at_once=True)
        assert len(one.to_say) == 4
        await until(lambda: len(other.heard) == 6)


async def test_what_hear_raises_is_the_end_and_nothing_more_is_heard() -> None:
    async with pair() as (one, other):
        wrong = ProtocolError("no such message")

        def on_frames(frames: list[bytes]) -> None:
            other.heard.extend(frames)
            raise wrong

        other.on_frames = on_frames
        one.say(b"1")
        await other.ended.wait()
        assert other.error is wrong
        late = framed([b"2"])  # that was on its way
        other.line.get_buffer(-1)[: len(late)] = late
        other.line.buffer_updated(len(late))
        assert other.heard == [b"1"]


async def test_what_fetch_raises_is_the_end_too() -> None:
    async with pair() as (one, _):
        wrong = RuntimeError("a fault of ours")

        def next_frames() -> list[bytes]:
            raise wrong

        one.line._next_frames = next_frames
        one.line.wake_writer()
        await one.ended.wait()
        assert one.error is wrong


class LastFrame(FrameReader):
    """Frames of a form in which a peer can say that one is the last."""

    has_ended = True

    def check(self) -> None:
        raise ConnectionLost("that was the last frame")


async def test_the_last_frame_is_handed_over_before_the_end() -> None:
    async with pair(LastFrame()) as (one, other):
        other.say(b"last")
        with anyio.fail_after(30):
            await one.ended.wait()
    assert one.heard == [b"last"]
    assert str(one.error) == "that was the last frame"


async def test_a_connection_that_is_reset_is_lost_with_its_cause() -> None:
    async with beside_a_socket() as (end, peer):
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        peer.close()
        with anyio.fail_after(30):
            await end.ended.wait()
        assert isinstance(end.error, ConnectionLost)
        assert str(end.error) == f"the connection to {end.line.peer} broke"
        assert isinstance(end.error.__cause__, ConnectionResetError)
        with pytest.raises(ConnectionLost, match=f"the connection to {end.line.peer} broke"):
            await end.line.send([b"after the end"])


async def test_the_last_word_waits_until_it_is_written_or_the_connection_is_lost() -> None:
    async with accepted() as (end, peer):
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        with anyio.fail_after(30):
            with anyio.move_on_after(0.01) as impatience:
                await end.line.send([bytes(2**23)])
            assert impatience.cancelled_caught
            async with anyio.create_task_group() as tasks:

                async def last_word() -> None:
                    with pytest.raises(ConnectionLost):
                        await end.line.send([b"1"])

                tasks.start_soon(last_word)
                await anyio.wait_all_tasks_blocked()
                peer.close()


class Leaving(FrameReader):
    """A form that has a goodbye, and expects one of the peer."""

    is_closed = False

    def goodbye(self) -> bytes:
        return bytes(2**22)

    def discard(self, data: bytes) -> None:
        self.is_closed = self.is_closed or data.endswith(b"goodbye")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let lines wait for their peers when they close, however busy the machine is."""
    monkeypatch.setattr(protocol_line, "LEAVE", 60.0)


@pytest.mark.usefixtures("patient")
async def test_the_goodbye_of_a_peer_that_reads_ours_slowly_is_waited_for() -> None:
    async with accepted() as (end, peer):
        line, leaving = end.line, Leaving()
        line.begin(leaving, b"")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(line.aclose)
            await until(lambda: line._is_full)
            await read(peer, 2**22)
            await until(lambda: not line._is_full)
            peer.send(framed([b"news"]) + b"goodbye")
        assert leaving.is_closed


async def test_bytes_are_read_before_it_runs_until_the_peer_closes() -> None:
    async with accepted() as (end, peer):
        line = end.line
        with anyio.fail_after(30):
            for number in (b"1", b"2"):
                peer.send(number)
                assert await line.receive_bytes() == number
            await line.send_bytes(b"answer")
            assert await read(peer, 6) == b"answer"
            peer.send(b"last")
            await until(lambda: line._early)
            peer.close()
            assert await line.receive_bytes() == b"last"
            with pytest.raises(anyio.BrokenResourceError):
                await line.receive_bytes()
            assert not line._transport.is_closing()


async def test_bytes_that_came_before_the_connection_was_lost_are_read_first() -> None:
    async with accepted() as (end, peer):
        peer.send(b"last")
        await until(lambda: end.line._early)
        end.line._transport.abort()
        assert await end.line.receive_bytes() == b"last"
        with anyio.fail_after(30), pytest.raises(anyio.BrokenResourceError):
            await end.line.receive_bytes()


async def test_a_line_is_closed_also_by_who_is_being_canceled() -> None:
    async with beside_a_socket() as (end, peer):
        with anyio.CancelScope() as scope:
            scope.cancel()
            await end.line.aclose()
        await until(lambda: end.line._transport.is_closing())
        await anyio.wait_readable(peer)
        assert peer.recv(10) == b""


class Ending(FrameReader):
    """A form that ends the stream, says no word before that, and expects the end of the peer."""

    is_closed = False
    ends_stream = True


async def test_a_peer_that_has_reset_the_connection_unnoticed_is_left_without_an_error() -> None:
    async with accepted() as (end, peer):
        end.line.begin(Ending(), b"")
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        peer.close()
        await end.line.aclose()  # before the event loop reads anything


async def test_a_connection_that_fails_ends_no_other(caplog: pytest.LogCaptureFixture) -> None:
    served: list[Line] = []

    async def serve(line: Line) -> None:
        served.append(line)
        await line.aclose()
        raise OSError(107, "not connected")

    async with await anyio.create_tcp_listener(local_host="127.0.0.1") as listener:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(accept, listener.listeners[0], FrameReader, serve, tasks)
            address: Any = listener.extra(SocketAttribute.local_address)
            for count in (1, 2):
                with socket.create_connection(address):
                    await until(lambda count=count: len(served) == count)  # type: ignore[misc]  # bound here, for now
            tasks.cancel_scope.cancel()
    assert {record.getMessage() for record in caplog.records} == {"a connection failed"}


async def test_small_messages_are_sent_at_once_by_both_ends() -> None:
    async with pair() as (one, other):
        for end in (one, other):
            made = end.line._transport.get_extra_info("socket")
            assert made.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


async def test_a_peer_that_has_left_before_it_was_looked_at_has_no_name() -> None:
    line = ProtocolLine(FrameReader(), memoryview(bytearray(10)))
    line.connection_made(_NoName())
    assert line.peer == "a peer that has left"


class _NoName(asyncio.Transport):
    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass


async def test_a_connection_that_fails_as_it_is_accepted_is_closed_and_harms_no_other(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    loop = asyncio.get_running_loop()
    take_over = loop.connect_accepted_socket
    failed: list[socket.socket] = []

    async def connect_accepted_socket(factory: Any, accepted: socket.socket) -> Any:
        if not failed:
            failed.append(accepted)
            raise OSError("no more")
        return await take_over(factory, accepted)

    monkeypatch.setattr(loop, "connect_accepted_socket", connect_accepted_socket)
    async with listening() as (address, ends):
        with socket.create_connection(address), socket.create_connection(address):
            await until(lambda: len(ends) == 1)
    assert failed[0].fileno() == -1
    assert [record.getMessage() for record in caplog.records] == [
        "a connection was lost as it was accepted: no more"
    ]


async def test_a_connection_that_is_being_accepted_is_closed_with_the_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken: list[socket.socket] = []

    async def connect_accepted_socket(factory: Any, accepted: socket.socket) -> Any:
        taken.append(accepted)
        await anyio.sleep_forever()

    loop = asyncio.get_running_loop()
    monkeypatch.setattr(loop, "connect_accepted_socket", connect_accepted_socket)
    async with listening() as (address, ends):
        with socket.create_connection(address):
            await until(lambda: taken)
    assert taken[0].fileno() == -1
    assert ends == []


async def test_clients_that_come_together_are_accepted_together_so_many_in_a_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = asyncio.get_running_loop()
    turns: list[int] = []
    turn = 0

    async def connect_accepted_socket(factory: Any, accepted: socket.socket) -> Any:
        turns.append(turn)
        await anyio.sleep_forever()

    monkeypatch.setattr(loop, "connect_accepted_socket", connect_accepted_socket)
    count = 2 * BATCH + 1
    async with listening() as (address, _):
        peers = [socket.create_connection(address) for _ in range(count)]
        with anyio.fail_after(30):
            while len(turns) < count:
                await anyio.lowlevel.checkpoint()
                turn += 1
        for peer in peers:
            peer.close()
    assert max(turns.count(one) for one in turns) == BATCH
    assert len(set(turns)) == 3


async def test_on_a_loop_of_somebody_else_addresses_are_tried_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, Any]] = []

    class OtherLoop:
        async def create_connection(self, *_: object, **settings: Any) -> tuple[str, str]:
            given.append(settings)
            return "transport", "line"

    monkeypatch.setattr(on_asyncio, "asyncio_loop", OtherLoop)
    made: object = await dial_tcp("robot", 1, FrameReader(), "robot")
    assert (made, given) == ("line", [{}])


@pytest.mark.parametrize(
    ("begin_at_once", "name", "settings"),
    [
        (False, "localhost", {"happy_eyeballs_delay": on_asyncio.NEXT_ADDRESS}),
        (True, "localhost", {}),
        (False, "127.0.0.1", {}),
    ],
)
async def test_addresses_of_a_name_are_tried_at_once_unless_tasks_begin_at_once(
    begin_at_once: bool, name: str, settings: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    given: list[dict[str, Any]] = []
    connect = loop.create_connection

    async def create_connection(*where: Any, **settings: Any) -> Any:
        given.append(settings)
        return await connect(*where, **settings)

    monkeypatch.setattr(loop, "create_connection", create_connection)
    if begin_at_once:
        monkeypatch.setattr(loop, "get_task_factory", lambda: asyncio.Task)
    async with listening() as ((_, port), _):
        line = await dial_tcp(name, port, FrameReader(), "the server")
        await line.aclose()
    assert given == [settings]


@pytest.mark.parametrize("turns", range(12))
async def test_a_dial_that_is_canceled_at_any_moment_leaves_no_socket(turns: int) -> None:
    async with listening() as ((host, port), _):
        dialing = asyncio.ensure_future(dial_tcp(host, port, FrameReader(), "the server"))
        for _ in range(turns):
            await anyio.lowlevel.checkpoint()
        dialing.cancel()
        with suppress(asyncio.CancelledError):
            await (await dialing).aclose()
        await anyio.wait_all_tasks_blocked()
        del dialing
        gc.collect()  # a socket that is still open is an error of the test
