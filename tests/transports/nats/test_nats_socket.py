"""The protocol of NATS on a connection, without a broker."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction_transports.nats.broker.broker import Message
from fibaction_transports.nats.broker.broker_socket import (
    LONGEST_LINE,
    MISSED_PINGS,
    BrokerSocket,
    headers_of,
    published,
)
from fibaction_transports.nats.broker.login import BrokerInfo
from tests.transports.hearing import Hearing

HEADERS = b"NATS/1.0\r\nNats-Sequence: 7\r\n\r\n"
STREAM = (
    b"PING\r\nMSG a 1 3\r\none\r\n+OK\r\nINFO {}\r\nMSG a.b 2 back 5\r\nt\r\nwo\r\n"
    b"HMSG c 3 %d %d\r\n%sthree\r\nHMSG d 4 back.d 16 16\r\nNATS/1.0 503\r\n\r\n\r\n"
    b"MSG e 5 0\r\n\r\n"
) % (len(HEADERS), len(HEADERS) + 5, HEADERS)
MESSAGES = [
    (1, Message("a", b"one", "", {})),
    (2, Message("a.b", b"t\r\nwo", "back", {})),
    (3, Message("c", b"three", "", {"Nats-Sequence": "7"})),
    (4, Message("d", b"", "back.d", {"Status": "503"})),
    (5, Message("e", b"", "", {})),
]


class Transport:
    """A connection that only notes what is done to it."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.protocol: Any = None
        self.is_aborted = False

    def set_protocol(self, protocol: Any) -> None:
        self.protocol = protocol

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def abort(self) -> None:
        self.is_aborted = True

    def is_closing(self) -> bool:
        return self.is_aborted


class Opened:
    """A socket, with all that it has handed over."""

    def __init__(self, early: bytes = b"") -> None:
        self.transport = Transport()
        self.messages: list[tuple[int, Message]] = []
        self.changes = 0
        self.socket = BrokerSocket(self.transport, BrokerInfo(), self._deliver, self._change)
        self.socket.begin(early)

    def _deliver(self, number: int, message: Message) -> None:
        self.messages.append((number, message))
        if message.data == b"bad":
            raise RuntimeError("bad")

    def _change(self) -> None:
        self.changes += 1

    def read(self, data: bytes) -> None:
        buffer = self.transport.protocol.get_buffer(-1)
        buffer[: len(data)] = data
        self.transport.protocol.buffer_updated(len(data))


@pytest.mark.parametrize("size", [1, 2, 7, 16, 64, 1000])
def test_messages_are_read_however_they_are_cut_into_pieces(size: int) -> None:
    opened = Opened(STREAM[:size])
    for start in range(size, len(STREAM), size):
        opened.read(STREAM[start : start + size])
    assert opened.messages == MESSAGES
    assert opened.transport.written == [b"PONG\r\n"]


def test_an_error_of_a_receiver_is_logged_and_the_next_message_comes(log: Hearing) -> None:
    opened = Opened()
    opened.read(b"MSG a 1 3\r\nbad\r\nMSG a 1 4\r\ngood\r\n")
    assert [message.data for _, message in opened.messages] == [b"bad", b"good"]
    assert [record.getMessage() for record in log.records if record.exc_info] == [
        "a message to a could not be handled"
    ]


@pytest.mark.parametrize(
    "data", [b"HTTP/1.1 200 OK\r\n", b"MSG a one 1\r\nx\r\n", b"MSG a 1 one\r\n"]
)
def test_another_protocol_ends_the_connection(data: bytes) -> None:
    opened = Opened()
    opened.read(data)
    assert opened.socket.is_lost
    assert not opened.messages


def test_a_line_without_end_ends_the_connection() -> None:
    assert Opened(bytes(LONGEST_LINE)).socket.is_ready
    assert not Opened(bytes(LONGEST_LINE + 1)).socket.is_ready


def test_an_error_of_the_broker_is_left_to_the_broker() -> None:
    opened = Opened()
    opened.read(b"-ERR 'Permissions Violation'\r\nMSG a 1 3\r\none\r\n")
    assert opened.messages == MESSAGES[:1]
    assert opened.socket.is_ready


@pytest.mark.parametrize("said", [b"PONG\r\n", b"MSG a 1 3\r\none\r\n", b"MSG a 1 9\r\npart"])
def test_a_broker_that_says_nothing_after_pings_is_lost(said: bytes) -> None:
    """Its answer may wait after the records that it was asked for."""
    opened = Opened()
    for _ in range(MISSED_PINGS):
        opened.socket.ping()
    opened.read(said)
    for _ in range(MISSED_PINGS):
        opened.socket.ping()
    assert opened.socket.is_ready
    opened.socket.ping()
    assert opened.socket.is_lost
    assert opened.transport.written == [b"PING\r\n"] * 2 * MISSED_PINGS


def test_nothing_is_written_while_the_broker_takes_nothing() -> None:
    opened = Opened()
    opened.socket.pause_writing()
    assert not opened.socket.is_ready
    opened.socket.resume_writing()
    assert opened.socket.is_ready
    assert opened.changes == 1
    opened.socket.connection_lost(None)
    assert opened.socket.is_lost
    assert opened.changes == 2


def test_a_message_is_written_with_its_headers() -> None:
    assert b"".join(published("a", b"x", "", None)) == b"PUB a  1\r\nx\r\n"
    assert b"".join(published("a", b"x", "b", {"N": "1", "M": "2"})) == (
        b"HPUB a b 24 25\r\nNATS/1.0\r\nN: 1\r\nM: 2\r\n\r\nx\r\n"
    )


def test_headers_are_read_with_the_status_that_a_broker_gives() -> None:
    assert headers_of(b"NATS/1.0 100 Idle Heartbeat\r\nLast:1\r\nB: a:b \r\n\r\n") == {
        "Status": "100",
        "Last": "1",
        "B": "a:b",
    }
    assert headers_of(b"NATS/1.0 503\r\n\r\n") == {"Status": "503"}
