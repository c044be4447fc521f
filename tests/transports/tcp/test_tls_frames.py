"""`fibaction_transports._socket_lines.tls`: frames inside TLS, without a network."""

from __future__ import annotations

import ssl
from collections.abc import Iterable

import anyio
import pytest
from hypothesis import given, strategies

from fibaction.wire.channel import CHUNK
from fibaction.wire.frames import FrameReader, framed
from fibaction.wire.transport import TlsFiles
from fibaction.words.errors import AuthenticationFailed, ConnectionLost, ProtocolError
from fibaction_transports._socket_lines.tls import (
    MOST_ANSWERS,
    TlsEnd,
    TlsFraming,
    shake_hands,
)
from tests.support.certificates import HOST, pems

LIMIT = 2**20
CLOSED = "closed its side"


def shaken(client: TlsEnd, server: TlsEnd) -> None:
    """Let both shake hands; with TLS 1.3 the client is through before the server."""
    for _ in range(3):
        for one, other in ((client, server), (server, client)):
            try:
                one.tls.do_handshake()
            except ssl.SSLWantReadError:
                pass
            finally:
                other.incoming.write(one.outgoing.read())


def ends(
    files: TlsFiles | None = None, newest: ssl.TLSVersion = ssl.TLSVersion.TLSv1_3
) -> tuple[TlsEnd, TlsEnd]:
    """A client and a server that have not shaken hands yet."""
    context = TlsFiles(ca=pems().ca).client()
    context.maximum_version = newest
    return TlsEnd(context, HOST), TlsEnd((files or TlsFiles(cert=pems().cert)).server())


def pair(
    frames: FrameReader | None = None, newest: ssl.TLSVersion = ssl.TLSVersion.TLSv1_3
) -> tuple[TlsFraming, TlsFraming]:
    """A client and a server that have shaken hands; the server may have another form of frames."""
    client, server = ends(newest=newest)
    shaken(client, server)
    return (
        TlsFraming(FrameReader(LIMIT), client, "robot"),
        TlsFraming(frames or FrameReader(LIMIT), server, "the client"),
    )


def fed(framing: TlsFraming, pieces: Iterable[bytes]) -> list[bytes]:
    return [frame for piece in pieces for frame in framing.feed(piece)]


@given(
    strategies.lists(strategies.lists(strategies.binary(max_size=300), max_size=4), max_size=4),
    strategies.integers(1, 400),
)
def test_frames_that_were_sent_come_out_in_any_chopping(
    writes: list[list[bytes]], size: int
) -> None:
    client, server = pair()
    data = b"".join(client.encode(frames) for frames in writes)
    pieces = [data[start : start + size] for start in range(0, len(data), size)]
    assert fed(server, pieces) == [frame for frames in writes for frame in frames]


@pytest.mark.parametrize("size", [CHUNK - 4, CHUNK - 3, 5 * CHUNK + 1])
def test_a_large_frame_comes_out_both_ways(size: int) -> None:
    client, server = pair()
    for one, other in ((client, server), (server, client)):
        data = one.encode([bytes(size), b"behind it"])
        assert not one.has_answer
        assert len(data) > size
        assert fed(other, [data]) == [bytes(size), b"behind it"]


def test_a_piece_of_a_record_is_not_a_frame_and_part_of_a_frame_is_known() -> None:
    client, server = pair()
    data = client.encode([b"x" * 20_000])
    assert server.feed(data[:100]) == []
    assert not server.is_within_frame
    assert server.feed(data[100:17_000]) == []
    assert server.is_within_frame
    assert server.feed(data[17_000:]) == [b"x" * 20_000]


def test_the_limit_of_a_frame_holds_inside_tls() -> None:
    client, server = pair(FrameReader(10))
    with pytest.raises(ProtocolError, match="frame of 11 bytes exceeds the limit of 10"):
        server.feed(client.encode([b"x" * 11]))


@pytest.mark.parametrize("newest", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_each_side_says_that_it_closes_and_then_nothing_more_is_expected(
    newest: ssl.TLSVersion,
) -> None:
    client, server = pair(newest=newest)
    last = client.goodbye()
    assert last
    assert not client.is_closed
    with pytest.raises(ConnectionLost, match=f"^the client {CLOSED}$"):
        server.feed(last)
    assert server.is_closed
    client.discard(server.encode([b"not read any more"]))
    assert not client.is_closed
    client.discard(server.goodbye())
    assert client.is_closed


def test_frames_before_a_close_are_handed_over_first() -> None:
    client, server = pair()
    assert server.feed(client.encode([b"one", b"two"]) + client.goodbye()) == [b"one", b"two"]
    with pytest.raises(ConnectionLost, match=CLOSED):
        server.check()


def test_a_close_within_a_message_is_said_to_be_one() -> None:
    client, server = pair()
    assert server.feed(client._encrypted(framed([b"whole"])[:-1])) == []
    with pytest.raises(ConnectionLost, match="the client closed in the middle of a message"):
        server.feed(client.goodbye())


def test_bytes_that_are_changed_on_the_way_end_the_connection_with_an_alert() -> None:
    client, server = pair()
    data = bytearray(client.encode([b"one"]))
    data[-1] ^= 1
    with pytest.raises(ConnectionLost, match="the connection to the client broke") as caught:
        server.feed(bytes(data))
    assert isinstance(caught.value.__cause__, ssl.SSLError)
    assert server.is_closed
    alert = server.goodbye()
    with pytest.raises(ConnectionLost, match="the connection to robot broke"):
        client.feed(alert)
    with pytest.raises(ConnectionLost, match="the connection to robot broke"):
        client.encode([b"too late"])
    client.goodbye()


def test_what_tls_has_to_say_by_itself_is_sent_and_is_bounded_if_nobody_reads_it() -> None:
    """Python cannot change keys, so the answers are put there."""
    client, server = pair()
    server.encode([])
    assert not server.has_answer
    server._outgoing.write(bytes(MOST_ANSWERS))
    assert server.has_answer
    assert server.feed(client.encode([b"one"])) == [b"one"]
    server.check()
    server._outgoing.write(b"x")
    assert server.feed(client.encode([b"two"])) == [b"two"]
    with pytest.raises(ConnectionLost, match="the client changes keys, and does not read"):
        server.check()
    assert server.encode([]) == bytes(MOST_ANSWERS) + b"x"


def test_a_server_that_wants_a_certificate_rejects_in_place_of_its_first_message() -> None:
    client, server = ends(TlsFiles(*pems()))
    with pytest.raises(ssl.SSLError):
        shaken(client, server)
    with pytest.raises(AuthenticationFailed, match="robot asks its clients for a certificate"):
        TlsFraming(FrameReader(), client, "robot").feed(b"")


class Talking(FrameReader):
    """A form with bytes of its own, as WebSocket has them."""

    has_answer = ends_stream = True
    discarded = b""

    def goodbye(self) -> bytes:
        return b"goodbye"

    def discard(self, data: bytes) -> None:
        self.discarded += data

    def check(self) -> None:
        raise ConnectionLost("the form has ended")


def test_the_form_inside_has_its_own_answer_and_goodbye_and_end() -> None:
    inside = Talking()
    client, server = pair(inside)
    assert server.has_answer
    assert server.ends_stream
    assert not client.has_answer
    assert not client.ends_stream
    with pytest.raises(ConnectionLost, match="the form has ended"):
        server.check()
    server.discard(client.encode([b"one"]))
    server.discard(client.goodbye())
    assert inside.discarded == framed([b"one"])
    with pytest.raises(ProtocolError, match="exceeds the limit"):
        client.feed(server.goodbye())


def test_what_is_incomplete_inside_is_forgotten_with_the_line() -> None:
    client, server = pair()
    server.feed(client._encrypted(framed([b"whole"])[:-1]))
    server.close()
    assert not server.is_within_frame


@pytest.mark.asyncio
async def test_a_handshake_that_the_peer_leaves_is_a_broken_connection() -> None:
    client, _ = ends()
    sent: list[bytes] = []

    async def send(data: bytes) -> None:
        sent.append(data)

    async def receive() -> bytes:
        raise anyio.EndOfStream

    with pytest.raises(anyio.BrokenResourceError):
        await shake_hands(client, receive, send)
    assert len(sent) == 1
    assert sent[0].startswith(b"\x16\x03")
