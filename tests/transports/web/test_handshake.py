"""`fibaction_transports.web.http.handshake`: requests and answers, byte for byte."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction.border.http_access import rules
from fibaction.wire.messages import Goodbye, Ping, Why, encode
from fibaction.words.errors import (
    AuthenticationFailed,
    ConnectionLost,
    InvalidURL,
    LimitReached,
    ProtocolError,
)
from fibaction_transports._http.http_exchange import http_answer
from fibaction_transports.web.http.handshake import ClientHandshake, ServerHandshake
from tests.transports.web.upgrade import UPGRADE, upgrade


def server() -> ServerHandshake:
    return ServerHandshake(rules("127.0.0.1", "/", hosts=(), origins=(), has_tls=False))


def head(answer: bytes) -> str:
    return answer.partition(b"\r\n\r\n")[0].decode()


def test_a_request_is_answered_as_in_the_rfc() -> None:
    shaking = server()
    # The key and its answer are the example of RFC 6455, section 1.3.
    key = b"dGhlIHNhbXBsZSBub25jZQ=="
    assert shaking.feed(upgrade({b"Sec-WebSocket-Key": key}) + b"rest") == b"rest"
    assert head(shaking.answer) == (
        "HTTP/1.1 101 Switching Protocols\r\n"
        "Upgrade: websocket\r\n"
        "Connection: Upgrade\r\n"
        "Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"
        "Sec-WebSocket-Protocol: fibaction.1"
    )


def test_a_request_may_come_in_single_bytes_and_have_several_items_in_its_headers() -> None:
    shaking = server()
    data = upgrade(
        {
            b"Connection": b"keep-alive, Upgrade",
            b"Sec-WebSocket-Protocol": b"other\r\nSec-WebSocket-Protocol: fibaction.1",
            b"Cookie": b"a=b",
        }
    )
    for number in range(len(data) - 1):
        assert shaking.feed(data[number : number + 1]) is None
    assert shaking.feed(data[-1:]) == b""
    assert shaking.answer.startswith(b"HTTP/1.1 101 ")


@pytest.mark.parametrize(("data", "status", "reason"), UPGRADE.values(), ids=UPGRADE)
def test_a_wrong_request_is_rejected_with_its_status(data: bytes, status: int, reason: str) -> None:
    shaking = server()
    with pytest.raises(ProtocolError, match=f"HTTP {status}: .*{reason}"):
        shaking.feed(data)
    assert shaking.answer.startswith(b"HTTP/1.1 %d " % status)
    assert b"\r\nConnection: close\r\n" in shaking.answer
    assert reason in shaking.answer.decode()
    assert shaking.feed(b"more") is None


def test_a_request_that_is_given_up_is_answered_with_the_reason() -> None:
    waiting = [encode(Ping()), encode(Goodbye("the server is full", Why.LIMIT))]
    answer = server().give_up(waiting)
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert answer.endswith(b"\r\n\r\nthe server is full\n")
    assert server().give_up([]).endswith(b"\r\n\r\nthe server is closing the connection\n")


def client() -> ClientHandshake:
    return ClientHandshake("robot:8080", "/arm")


def test_the_request_of_a_client_is_one_that_a_server_answers() -> None:
    asking = client()
    assert asking.answer.startswith(b"GET /arm HTTP/1.1\r\nHost: robot:8080\r\n")
    shaking = ServerHandshake(rules("robot", "/arm", hosts=(), origins=(), has_tls=False))
    assert shaking.feed(asking.answer) == b""
    assert asking.feed(shaking.answer[:-1]) is None
    assert asking.feed(shaking.answer[-1:] + b"rest") == b"rest"
    assert asking.give_up([encode(Ping())]) == b""


PLAIN = b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n"
SWITCHED = b"HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
ANSWERS: dict[str, tuple[bytes, type[Exception], str]] = {
    "another protocol": (b"\0\0\0\2\x91\0\r\n\r\n", ProtocolError, "does not speak HTTP"),
    "a page": (PLAIN, ProtocolError, "HTTP 200: OK"),
    "nothing there": (http_answer(404, "no such path"), ProtocolError, "HTTP 404: no such path; "),
    "a page of another server": (
        b"HTTP/1.1 404 Not Found\r\nContent-Type: text/html\r\nContent-Length: 4\r\n\r\n<h1>",
        ProtocolError,
        "^HTTP 404: Not Found; this may be another web server: check the port and the path$",
    ),
    "forbidden": (http_answer(403, "a page"), AuthenticationFailed, "HTTP 403: a page"),
    "forbidden without a word": (
        b"HTTP/1.1 403 \r\nContent-Length: 0\r\n\r\n",
        AuthenticationFailed,
        "nothing at /arm, or this client may not use it; an action that is mounted is at /arm/, wi",
    ),
    "full": (http_answer(503, "it is full"), LimitReached, "HTTP 503: it is full"),
    "a broken body": (
        b"HTTP/1.1 502 Bad Gateway\r\nTransfer-Encoding: chunked\r\n\r\nxyz\r\n",
        ConnectionLost,
        "HTTP 502: Bad Gateway",
    ),
    "no accept": (SWITCHED + b"\r\n", ProtocolError, "its Sec-WebSocket-Accept is wrong"),
    "an endless head": (b"HTTP/1.1 200 OK\r\n" + b"A: b\r\n" * 9999, ProtocolError, "HTTP"),
}


@pytest.mark.parametrize(("answer", "error", "text"), ANSWERS.values(), ids=ANSWERS)
def test_a_wrong_answer_is_an_error_that_says_whether_to_try_again(
    answer: bytes, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        client().feed(answer)


def test_a_server_must_choose_the_subprotocol() -> None:
    asking = client()
    shaking: Any = ServerHandshake(rules("robot", "/arm", hosts=(), origins=(), has_tls=False))
    shaking.feed(asking.answer)
    with pytest.raises(ProtocolError, match=r"does not speak the subprotocol fibaction\.1"):
        asking.feed(shaking.answer.replace(b"fibaction.1", b"other"))


def test_a_host_that_cannot_be_asked_for_is_an_invalid_url() -> None:
    with pytest.raises(InvalidURL, match="invalid host"):
        ClientHandshake("robot\n", "/")
    with pytest.raises(UnicodeError):
        ClientHandshake("rö..bot", "/")
    assert b"\r\nHost: xn--rbot-5qa:80\r\n" in ClientHandshake("röbot:80", "/").answer
