"""`fibaction_transports.web.http.websocket_frames`: frames in messages, without a network."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wsproto.connection import Connection, ConnectionType
from wsproto.events import BytesMessage, CloseConnection, Event, Ping, Pong, TextMessage

from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.http_access import rules
from fibaction.wire.frames import FrameMemory, FrameReader, framed, header
from fibaction.words.errors import ActionError, ConnectionLost, LimitReached, ProtocolError
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake
from fibaction_transports.web.http.websocket_frames import BinaryMessages, WebSocketFraming
from tests.transports.web.upgrade import upgrade

LIMIT = 1000


def server(reader: FrameReader | None = None) -> WebSocketFraming:
    admitted = rules("robot", "/", hosts=(), origins=(), has_tls=False)
    messages = BinaryMessages(reader or FrameReader(LIMIT))
    return WebSocketFraming("the client", messages, ServerHandshake(admitted))


def client() -> WebSocketFraming:
    messages = BinaryMessages(FrameReader(LIMIT))
    return WebSocketFraming("the robot", messages, ClientHandshake("robot", "/"))


def both() -> tuple[WebSocketFraming, WebSocketFraming]:
    """A client and a server that have shaken hands."""
    asking, answering = client(), server()
    assert answering.feed(asking.encode([])) == []
    assert asking.feed(answering.encode([])) == []
    return asking, answering


class Peer:
    """A client made of wsproto alone, at a server that has shaken hands."""

    def __init__(self, reader: FrameReader | None = None) -> None:
        self.server = server(reader)
        self.server.feed(upgrade())
        self.server.encode([])
        self.socket = Connection(ConnectionType.CLIENT)

    def says(self, *events: Event) -> list[bytes]:
        return self.server.feed(b"".join(map(self.socket.send, events)))

    def hears(self, data: bytes) -> list[Event]:
        self.socket.receive_data(data)
        return list(self.socket.events())


def test_frames_that_are_ready_at_once_are_one_message_and_come_back_one_by_one() -> None:
    asking, answering = both()
    for one, other in ((asking, answering), (answering, asking)):
        frames = [b"one", b"", b"three" * 100]
        assert other.feed(one.encode(frames)) == frames
        assert not other.is_within_frame
    peer = Peer()
    (message,) = peer.hears(peer.server.encode([b"one", b"two"]))
    assert message == BytesMessage(data=framed([b"one", b"two"]))


@given(st.lists(st.binary(max_size=50)), st.lists(st.integers(0, 2000)))
def test_pieces_of_any_size_make_the_same_frames(frames: list[bytes], cuts: list[int]) -> None:
    asking, answering = both()
    data = asking.encode(frames)
    got: list[bytes] = []
    for start, end in pairwise(sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})):
        got += answering.feed(data[start:end])
    assert got == frames


def test_fragments_and_controls_between_them_make_no_difference() -> None:
    peer, data = Peer(), framed([b"abcdef", b"gh"])
    assert peer.says(BytesMessage(data=data[:7], message_finished=False)) == []
    assert peer.server.is_within_frame
    assert peer.says(Ping(payload=b"1"), Pong(payload=b"x"), Ping(payload=b"2")) == []
    assert peer.says(BytesMessage(data=data[7:])) == [b"abcdef", b"gh"]
    # Only the last ping needs an answer.
    assert peer.server.has_answer
    pong, message = peer.hears(peer.server.encode([b"reply"]))
    assert (pong, message) == (Pong(payload=b"2"), BytesMessage(data=framed([b"reply"])))
    assert not peer.server.has_answer
    assert peer.server.encode([]) == b""


def test_frames_wait_until_the_hands_are_shaken() -> None:
    asking, answering = client(), server()
    request = asking.encode([b"hello"])
    assert request.startswith(b"GET / ")
    assert answering.encode([b"ping"]) == b""
    assert answering.feed(request) == []
    assert asking.feed(answering.encode([])) == [b"ping"]
    assert asking.has_answer
    assert answering.feed(asking.encode([])) == [b"hello"]


WRONG: dict[str, tuple[Callable[[Peer], object], int, str]] = {
    "text": (lambda peer: peer.says(TextMessage(data="{}")), 1003, "it sent a text message"),
    "half a frame": (
        lambda peer: peer.says(BytesMessage(data=header(9) + b"abc")),
        1007,
        "a WebSocket message ended within a frame",
    ),
    "a frame over the limit": (
        lambda peer: peer.says(BytesMessage(data=header(LIMIT + 1), message_finished=False)),
        1009,
        "frame of 1001 bytes exceeds the limit of 1000 bytes",
    ),
    "no mask": (lambda peer: peer.server.feed(b"\x82\x01a"), 1002, "invalid WebSocket data: "),
    "an unknown opcode": (lambda peer: peer.server.feed(b"\x83\x80abcd"), 1002, "Invalid opcode"),
    "compression": (lambda peer: peer.server.feed(b"\xc2\x80abcd"), 1002, "invalid WebSocket"),
    "a long ping": (lambda peer: peer.server.feed(b"\x89\xfe\0\x7eabcd"), 1002, "invalid"),
    "bad UTF-8": (
        lambda peer: peer.server.feed(b"\x81\x82\0\0\0\0\xff\xff"),
        1007,
        "invalid WebSocket data: ",
    ),
}


@pytest.mark.parametrize(("break_it", "code", "text"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_ends_the_connection_with_the_code_that_fits(
    break_it: Callable[[Peer], object], code: int, text: str
) -> None:
    peer = Peer()
    with pytest.raises(ProtocolError, match=text):
        break_it(peer)
    assert peer.hears(peer.server.encode([b"reason"])) == [BytesMessage(data=framed([b"reason"]))]
    (close,) = peer.hears(peer.server.goodbye())
    assert isinstance(close, CloseConnection)
    assert close.code == code
    # Nothing of it can be read any more: the line waits for the end of the stream.
    peer.server.discard(peer.socket.send(close.response()))
    assert not peer.server.is_closed


def test_a_large_message_is_counted_while_its_pieces_arrive() -> None:
    memory = FrameMemory(ByteBudget(2**17))
    peer = Peer(FrameReader(2**20, memory=memory))
    assert peer.says(BytesMessage(data=header(2**18), message_finished=False)) == []
    with pytest.raises(LimitReached):
        for _ in range(4):
            peer.says(BytesMessage(data=bytes(2**16), message_finished=False))
    (close,) = peer.hears(peer.server.goodbye())
    assert isinstance(close, CloseConnection)
    assert close.code == 1013


def test_a_peer_that_closes_gets_its_answer_and_its_reason_is_told() -> None:
    peer = Peer()
    with pytest.raises(ConnectionLost, match=r"^the client closed: 1001 the tab is gone$"):
        peer.says(CloseConnection(code=1001, reason="the tab is gone"))
    assert peer.server.encode([b"lost"]) == b""
    (close,) = peer.hears(peer.server.goodbye())
    assert isinstance(close, CloseConnection)
    assert close.code == 1001
    assert peer.server.is_closed


def test_what_comes_behind_a_close_does_not_count() -> None:
    peer = Peer()
    close = b"\x88\x80abcd"
    with pytest.raises(ConnectionLost, match=r"^the client closed: 1005$"):
        peer.server.feed(close + close + b"\x83\x80abcd")
    with pytest.raises(ConnectionLost):
        peer.server.feed(close)


def test_frames_before_a_close_in_one_piece_are_not_lost() -> None:
    peer = Peer()
    assert peer.says(BytesMessage(data=framed([b"bye"])), CloseConnection(code=1000)) == [b"bye"]
    with pytest.raises(ConnectionLost, match="the client closed: 1000"):
        peer.server.check()
    (close,) = peer.hears(peer.server.goodbye())
    assert close == CloseConnection(code=1000, reason="")


def test_a_ping_before_a_close_needs_no_pong() -> None:
    peer = Peer()
    with pytest.raises(ConnectionLost):
        peer.says(Ping(payload=b"1"), CloseConnection(code=1000))
    assert peer.hears(peer.server.goodbye()) == [CloseConnection(code=1000, reason="")]
    assert not peer.server.has_answer


def test_both_may_close_at_once() -> None:
    asking, answering = both()
    one, other = asking.goodbye(), answering.goodbye()
    assert not asking.is_closed
    answering.discard(one)
    asking.discard(other)
    assert asking.is_closed
    assert answering.is_closed
    answering.discard(b"anything")
    assert asking.goodbye() == b""


def test_what_arrives_after_our_close_is_ignored() -> None:
    peer = Peer()
    last = peer.server.goodbye()
    peer.server.discard(peer.socket.send(BytesMessage(data=b"no frame")))
    peer.server.discard(peer.socket.send(Ping()))
    assert not peer.server.is_closed
    (close,) = peer.hears(last)
    assert isinstance(close, CloseConnection)
    peer.server.discard(peer.socket.send(close.response()))
    assert peer.server.is_closed
    assert peer.server.encode([b"more"]) == b""


def test_a_server_that_gives_up_before_the_handshake_answers_by_http_and_waits_for_the_end() -> (
    None
):
    answering = server()
    answering.feed(upgrade()[:20])
    assert answering.goodbye().startswith(b"HTTP/1.1 503 ")
    answering.discard(b"more")
    assert not answering.is_closed
    rejected = server()
    with pytest.raises(ActionError):
        rejected.feed(b"nonsense\r\n\r\n")
    assert rejected.encode([b"goodbye"]).startswith(b"HTTP/1.1 400 ")
    assert rejected.goodbye() == b""


def test_the_end_of_the_line_frees_what_is_incomplete() -> None:
    peer = Peer()
    peer.says(BytesMessage(data=header(9) + b"abc", message_finished=False))
    peer.server.close()
    assert not peer.server.is_within_frame
