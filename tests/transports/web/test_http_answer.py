"""The bytes of answers, as h11 reads them at the client."""

from __future__ import annotations

from typing import Any, cast

import h11
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fibaction_transports._http.http_exchange import HttpAnswer, HttpExchange


class Arriving:
    """A stream from which the body of a request arrives."""

    async def receive(self, size: int) -> bytes:
        return b"ab"


ASKED = [(b"host", b"here")]


def asked(
    method: str = "GET", version: str = "1.1", *headers: tuple[bytes, bytes]
) -> tuple[h11.Request, h11.Connection]:
    """Return a request, and the client that has sent it."""
    client = h11.Connection(h11.CLIENT)
    client.send(h11.Request(method=method, target="/", headers=[*ASKED, *headers]))
    client.send(h11.EndOfMessage())
    # A client of h11 speaks HTTP/1.1 only.
    request = h11.Request(
        method=method, target="/", headers=[*ASKED, *headers], http_version=version
    )
    return request, client


def read(client: h11.Connection, data: bytes, *, is_last: bool) -> tuple[h11.Response, bytes]:
    """Return the head and the body of an answer that is complete."""
    client.receive_data(data)
    if is_last:
        client.receive_data(b"")
    response, body = client.next_event(), b""
    assert isinstance(response, h11.Response)
    while not isinstance(event := client.next_event(), h11.EndOfMessage):
        assert isinstance(event, h11.Data)
        body += bytes(event.data)
    return response, body


@given(
    method=st.sampled_from(["GET", "HEAD", "POST"]),
    version=st.sampled_from(["1.0", "1.1"]),
    status=st.sampled_from([200, 201, 204, 304, 404]),
    pieces=st.lists(st.binary(max_size=40), max_size=4),
    has_length=st.booleans(),
    closes=st.sampled_from([(), ((b"connection", b"keep-alive, Close"),)]),
)
def test_a_client_reads_the_head_and_the_body_that_were_written(
    method: str,
    version: str,
    status: int,
    pieces: list[bytes],
    has_length: bool,
    closes: tuple[tuple[bytes, bytes], ...],
) -> None:
    request, client = asked(method, version, *closes)
    answer = HttpAnswer(request)
    if method == "HEAD" or status in (204, 304):
        pieces = []
    headers = [(b"x-one", b"1"), (b"transfer-encoding", b"gzip")]
    if has_length:
        headers.append((b"content-length", str(len(b"".join(pieces))).encode()))
    assert not answer.has_begun
    data = answer.begin(status, headers)
    data += b"".join(answer.piece(piece, has_more=True) for piece in pieces)
    assert not answer.is_complete
    data += answer.piece(b"", has_more=False)
    assert answer.is_complete
    response, body = read(client, data, is_last=answer.is_last)
    assert (response.status_code, body) == (status, b"".join(pieces))
    assert (b"x-one", b"1") in response.headers
    assert ((b"connection", b"close") in response.headers) is answer.is_last
    assert answer.is_last is (version == "1.0" or bool(closes))
    assert client.our_state is (h11.MUST_CLOSE if answer.is_last else h11.DONE)


def test_without_a_length_the_body_comes_in_chunks_and_old_clients_read_it_to_the_end() -> None:
    for version, ends in (("1.1", b"transfer-encoding: chunked"), ("1.0", b"connection: close")):
        request, client = asked(version=version)
        answer = HttpAnswer(request)
        data = answer.begin(200, []) + answer.piece(b"some", has_more=True)
        assert ends in data
        data += answer.piece(b"thing", has_more=False)
        assert read(client, data, is_last=answer.is_last)[1] == b"something"


@pytest.mark.parametrize(
    "headers",
    [
        [(b"content-length", b"0"), (b"transfer-encoding", b"chunked")],
        [(b"upgrade", b"h2c"), (b"connection", b"upgrade")],
    ],
)
def test_a_connection_ends_after_a_request_whose_end_is_unclear(
    headers: list[tuple[bytes, bytes]],
) -> None:
    request = h11.Request(method="GET", target="/", headers=[*ASKED, *headers])
    assert HttpAnswer(request).is_last


def test_an_application_may_end_the_connection() -> None:
    answer = HttpAnswer(asked()[0])
    assert b"connection: close" in answer.begin(200, [(b"connection", b"Close")])
    assert answer.is_last


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
def test_a_header_with_a_line_break_is_not_written(end: bytes) -> None:
    answer = HttpAnswer(asked()[0])
    with pytest.raises(ValueError, match="a header of the answer has a line break"):
        answer.begin(200, [(b"location", b"/" + end + b"set-cookie: a=b")])
    assert not answer.has_begun


@pytest.mark.parametrize(("body", "wrong_by"), [(b"1234", 1), (b"12", 1), (b"", 3)])
def test_a_body_of_another_length_than_told_is_an_error(body: bytes, wrong_by: int) -> None:
    answer = HttpAnswer(asked()[0])
    answer.begin(200, [(b"content-length", b"3")])
    with pytest.raises(ValueError, match=f"the length of the answer is wrong by {wrong_by} bytes"):
        answer.piece(body, has_more=False)
    assert not answer.is_complete


@pytest.mark.anyio
async def test_a_client_that_waits_to_be_asked_for_its_body_is_not_asked_within_an_answer() -> None:
    http = h11.Connection(h11.SERVER)
    http.receive_data(b"POST / HTTP/1.1\r\nhost: h\r\nexpect: 100-continue\r\n")
    http.receive_data(b"content-length: 2\r\n\r\n")
    request = http.next_event()
    assert isinstance(request, h11.Request)
    sent = list[bytes]()

    async def send(data: bytes) -> None:
        sent.append(data)

    exchange = HttpExchange(http, cast("Any", Arriving()), send, request, "", "http", "")
    await exchange.send({"type": "http.response.start", "status": 200, "headers": []})
    await exchange.send({"type": "http.response.body", "body": b"some", "more_body": True})
    assert (await exchange.receive())["body"] == b"ab"
    assert len(sent) == 1
    assert b" 100 " not in sent[0]
