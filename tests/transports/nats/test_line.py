"""Lines over a real nats-server: the wire protocol on them, and each way in which they break."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable

import anyio
import pytest

from fibaction import ServerNotFound
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background
from fibaction.wire.channel import Line, NextFrames, OnFrames
from fibaction.wire.frames import FrameReader
from fibaction.words.errors import ConnectionLost, ProtocolError
from fibaction_transports.nats.broker.broker import Message
from fibaction_transports.nats.broker.nats_broker import NatsBroker, open_broker
from fibaction_transports.nats.lines import WINDOW, ClientLines, PieceLine, WorkerLines
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings
from tests.support.nats_server import NatsServer

pytestmark = pytest.mark.anyio


# Each end alone


class End:
    """One end of a line, which a test reads and writes."""

    def __init__(self, line: Line) -> None:
        assert isinstance(line, PieceLine)
        self.line = line
        self.frames: list[bytes] = []
        self.error: BaseException | None = None
        self._news = Notifier()

    async def run(
        self, on_frames: OnFrames | None = None, next_frames: NextFrames = lambda: []
    ) -> None:
        """Run the line, and note the error that ends it."""
        try:
            await self.line.run(on_frames or self._on_frames, next_frames)
        except Exception as exc:
            self.error = exc
            self._news.notify()

    def _on_frames(self, frames: list[bytes]) -> list[bytes]:
        self.frames += frames
        self._news.notify()
        return []

    async def until(self, is_so: Callable[[], bool]) -> None:
        with anyio.fail_after(10):
            while not is_so():
                await self._news.wait()

    async def lost(self) -> str:
        """The reason why the line ends, while nothing else runs it."""
        with anyio.fail_after(10):
            await self.run()
        assert isinstance(self.error, ConnectionLost)
        return str(self.error)


class Ends:
    """A client's end and a worker's end of one line, and the connection below."""

    def __init__(self, client: Line, worker: Line, broker: NatsBroker, names: FleetNames) -> None:
        self.client = End(client)
        self.worker = End(worker)
        self.broker = broker
        self.names = names

    def to_worker(self, data: bytes) -> None:
        self.broker.publish(self.names.up("w", "c", "1"), data)


@pytest.fixture
async def ends(shared_broker: NatsServer, fleet: str) -> AsyncGenerator[Ends, None]:
    names, settings = FleetNames(fleet), FleetSettings(fleet, (shared_broker.address,))
    started: list[Line] = []
    async with open_broker(settings) as there, open_broker(settings) as here:
        workers = WorkerLines(there, names, "w", FrameReader, started.append)
        clients = ClientLines(here, names, "c")
        await workers.open()
        await clients.open()
        line = await clients.dial("w")
        yield Ends(line, started[0], here, names)
        await line.aclose()
        clients.close()
        workers.close()


def piece(number: int, data: bytes = b"", kind: bytes = b"D") -> bytes:
    return kind + number.to_bytes(8, "big") + data


async def test_has_no_responders_where_no_worker_is(shared_broker: NatsServer, fleet: str) -> None:
    async with open_broker(FleetSettings(fleet, (shared_broker.address,))) as broker:
        lines = ClientLines(broker, FleetNames(fleet))
        await lines.open()
        with anyio.fail_after(10), pytest.raises(ServerNotFound, match="'w' does not answer"):
            await lines.dial("w")


async def test_a_reader_that_takes_nothing_holds_the_sender_back(ends: Ends) -> None:
    fetched = 0

    def next_frames() -> list[bytes]:
        nonlocal fetched
        fetched += 1
        return [bytes(1000)] if fetched <= 10 * WINDOW else []

    async with Background() as tasks:
        tasks.start_soon(ends.client.run, None, next_frames)
        with anyio.move_on_after(0.3):
            await anyio.sleep_forever()
        assert fetched == WINDOW
        assert ends.client.line.progress == 0
        tasks.start_soon(ends.worker.run)
        await ends.worker.until(lambda: len(ends.worker.frames) == 10 * WINDOW)
        await ends.broker.flush()
        assert ends.client.line.progress >= 9 * WINDOW


async def test_frames_that_are_left_come_again_in_later_turns_before_others(ends: Ends) -> None:
    taken: list[bytes] = []
    done = anyio.Event()

    def one_at_once(frames: list[bytes]) -> list[bytes]:
        taken.extend(frames[:1])
        if len(taken) == 4:
            done.set()
        return frames[1:]

    ends.worker.line.share_turns(anyio.Lock())
    async with Background() as tasks:
        tasks.start_soon(ends.worker.run, one_at_once)
        await ends.client.line.send([b"1", b"2", b"3"])
        await ends.client.line.send([b"4"])
        with anyio.fail_after(5):
            await done.wait()
        assert taken == [b"1", b"2", b"3", b"4"]


async def test_a_write_at_once_is_not_put_off(ends: Ends) -> None:
    frames: list[bytes] = []

    def next_frames() -> list[bytes]:
        ends.client.line.wake_writer(at_once=True)  # while it is fetched
        one, frames[:] = frames[:], []
        return one

    async with Background() as tasks:
        tasks.start_soon(ends.client.run, None, next_frames)
        await anyio.lowlevel.checkpoint()
        tasks.start_soon(ends.worker.run)
        frames.append(b"now")
        ends.client.line.wake_writer(at_once=True)
        assert not frames
        await ends.worker.until(lambda: ends.worker.frames == [b"now"])


@pytest.mark.parametrize("fails_at", [1, 2])
async def test_an_error_of_a_handler_or_a_source_ends_the_line(ends: Ends, fails_at: int) -> None:
    calls = 0

    def fail(frames: list[bytes] | None = None) -> list[bytes]:
        nonlocal calls
        calls += 1
        if frames and calls < fails_at:
            return frames  # they are left
        raise ProtocolError("no")

    await ends.client.line.send([b"x"])
    with anyio.fail_after(30):
        await ends.worker.run(fail)
        await ends.client.run(None, fail)
    assert isinstance(ends.worker.error, ProtocolError)
    assert isinstance(ends.client.error, ProtocolError)


async def test_a_lost_piece_breaks_the_line(ends: Ends) -> None:
    ends.to_worker(piece(1))
    assert await ends.worker.lost() == "a piece of the line to nats client c was lost"
    line = ends.worker.line
    assert isinstance(line, PieceLine)
    line.handle(Message("", piece(0, b"\0\0\0\1x"), ""))
    assert ends.worker.frames == []


async def test_what_came_before_the_end_is_still_read(ends: Ends) -> None:
    await ends.client.line.send([b"last"])
    await ends.client.line.aclose()
    assert await ends.worker.lost() == "nats client c closed its side"
    assert ends.worker.frames == [b"last"]
    with pytest.raises(ConnectionLost):
        await ends.worker.line.send([b"x"])


async def test_an_end_that_is_gone_is_noticed_at_once(
    ends: Ends, shared_broker: NatsServer, fleet: str
) -> None:
    ends.to_worker(b"")
    assert await ends.worker.lost() == "nats client c sent a piece that is too short"
    names, settings = FleetNames(fleet), FleetSettings(fleet, (shared_broker.address,))
    async with open_broker(settings) as here:
        clients = ClientLines(here, names)
        await clients.open()
        async with open_broker(settings) as there:
            workers = WorkerLines(there, names, "v", FrameReader, lambda line: None)
            await workers.open()
            line = await clients.dial("v")
        assert isinstance(line, PieceLine)
        while line._error is None:  # the broker may notice later that it is gone
            await line.send([b"x"])
            await here.flush()
        assert await End(line).lost() == "worker 'v' is gone"


async def test_more_pieces_than_the_window_break_the_line(ends: Ends) -> None:
    for number in range(WINDOW + 1):
        ends.to_worker(piece(number))
    line = ends.worker.line
    with anyio.fail_after(30):
        while line._error is None:
            await line._changed.wait()
    assert await ends.worker.lost() == f"nats client c sent more than {WINDOW} pieces"


async def test_acknowledgements_that_cannot_be_are_ignored(ends: Ends) -> None:
    ends.to_worker(piece(7, kind=b"A"))
    ends.to_worker(piece(7, kind=b"?"))
    ends.to_worker(piece(0, b"\0\0\0\1x"))
    async with Background() as tasks:
        tasks.start_soon(ends.worker.run)
        await ends.worker.until(lambda: ends.worker.frames == [b"x"])
    assert ends.worker.line.progress == 0


async def test_sending_waits_for_the_window(ends: Ends) -> None:
    large = bytes(2**16 * (WINDOW + 2))
    with anyio.move_on_after(0.2) as scope:
        await ends.client.line.send([large])
    assert scope.cancelled_caught
    async with Background() as tasks:
        tasks.start_soon(ends.client.run)
        tasks.start_soon(ends.worker.run)
        await ends.worker.until(lambda: ends.worker.frames == [large])


async def test_a_worker_that_stops_ends_its_lines(shared_broker: NatsServer, fleet: str) -> None:
    names, settings = FleetNames(fleet), FleetSettings(fleet, (shared_broker.address,))
    started: list[Line] = []
    async with open_broker(settings) as broker:
        workers = WorkerLines(broker, names, "w", FrameReader, started.append)
        workers.close()  # before it was opened
        await workers.open()
        clients = ClientLines(broker, names)
        clients.close()  # as well
        await clients.open()
        await clients.dial("w")
        workers.close()
        assert await End(started[0]).lost() == "the worker has stopped"


async def test_a_message_for_an_unknown_line_is_ignored(ends: Ends) -> None:
    heard: list[Message] = []
    await ends.broker.subscribe(ends.names.down("d"), heard.append)
    ends.broker.publish(ends.names.down("c", "9"), piece(0))
    ends.broker.publish(ends.names.up("w", "d", "1"), piece(0, kind=b"A"))
    ends.broker.publish(ends.names.up("w", "d", "2"), piece(0))
    with anyio.fail_after(30):
        while not heard:
            await ends.broker.flush()
    assert [(one.subject, one.data[:1]) for one in heard] == [(ends.names.down("d", "2"), b"X")]
