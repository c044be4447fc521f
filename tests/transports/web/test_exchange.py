"""`fibaction_transports._http.exchange`: answers that clients take slowly, and those of others."""

from __future__ import annotations

import gzip
from typing import Any

import anyio
import pytest

from fibaction.border.byte_budgets import ByteBudget
from fibaction.wire.frames import FrameMemory
from fibaction.words.errors import ConnectionLost
from fibaction_transports._http.exchange import Exchange

pytestmark = pytest.mark.anyio

SCOPE = {"method": "GET", "path": "/", "headers": []}


async def receive() -> Any:
    await anyio.sleep_forever()


async def deaf(message: Any) -> None:
    if message["type"] == "http.response.body":
        await anyio.sleep_forever()


async def test_of_a_parameter_that_comes_several_times_the_last_counts() -> None:
    exchange = Exchange(SCOPE | {"query_string": b"a=1&b=&a=2%2B"}, receive, deaf)
    assert [exchange.parameter(name) for name in "abc"] == ["2+", "", None]


async def test_a_large_answer_goes_in_pieces_and_counts_meanwhile() -> None:
    budget = ByteBudget(300_000)
    counted: list[int] = []
    pieces: list[int] = []

    async def send(message: Any) -> None:
        if message["type"] == "http.response.body":
            counted.append(budget.used)
            pieces.append(len(message["body"]))

    await Exchange(SCOPE, receive, send, 60.0, FrameMemory(budget)).answer(200, bytes(200_000))
    assert min(counted) > 0
    assert (max(pieces), sum(pieces)) == (2**16, 200_000)
    assert budget.used == 0


async def test_the_largest_answer_is_given_up_when_all_together_are_too_large() -> None:
    budget = ByteBudget(300_000)
    memory = FrameMemory(budget)
    large, other = (Exchange(SCOPE, receive, deaf, 60.0, memory) for _ in range(2))

    async def write_other() -> None:
        await anyio.wait_all_tasks_blocked()
        await other.answer(200, bytes(200_000))

    with anyio.fail_after(20):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(write_other)
            with pytest.raises(ConnectionLost, match="too long for a large answer at a busy"):
                await large.answer(200, bytes(300_000))
            assert 0 < budget.used < 200_000
            tasks.cancel_scope.cancel()
    assert budget.used == 0


# Applications of others


class Asked:
    """What an application of others was asked, and what its client got."""

    def __init__(self) -> None:
        self.scope: Any = {}
        self.received: list[Any] = []
        self.sent: list[Any] = []

    async def app(self, scope: Any, receive: Any, send: Any) -> None:
        self.scope = scope
        self.received.append(await receive())
        headers = [(b"content-type", b"text/plain")]
        await send({"type": "http.response.start", "status": 201, "headers": headers})
        for has_more in (True, True, False):
            await send({"type": "http.response.body", "body": b"piece", "more_body": has_more})
        self.received.append(await receive())

    async def send(self, message: Any) -> None:
        self.sent.append(message)

    async def be_asked(self, send: Any, *messages: Any, **scope: Any) -> None:
        """Ask for the body in these messages, after which the client goes."""
        left = list(messages)

        async def receive() -> Any:
            return left.pop(0) if left else {"type": "http.disconnect"}

        exchange = Exchange({**SCOPE, **scope}, receive, send, 0.05)
        exchange.more_headers.append(("Vary", "Origin"))
        await exchange.hand_to(self.app, {"client": "a robot"}, 10, ByteBudget(100))


async def test_another_application_gets_the_whole_body_and_the_state_and_answers() -> None:
    asked = Asked()
    piece = {"type": "http.request", "body": b"12345"}
    await asked.be_asked(asked.send, piece | {"more_body": True}, piece, state={"own": 1})
    assert asked.scope["state"] == {"own": 1, "client": "a robot"}
    assert [one.get("body") for one in asked.received] == [b"1234512345", None]
    begin, *body = asked.sent
    assert (begin["status"], begin["headers"][-1]) == (201, (b"Vary", b"Origin"))
    assert b"".join(one["body"] for one in body) == b"piece" * 3


async def test_the_head_of_a_stream_of_events_does_not_wait_for_the_first_of_them() -> None:
    sent = list[Any]()

    async def app(scope: Any, receive: Any, send: Any) -> None:
        headers = [(b"content-type", b"text/event-stream; charset=utf-8")]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        assert [one["type"] for one in sent] == ["http.response.start", "http.response.body"]
        await send({"type": "http.response.body", "body": b"data: 1\n\n"})

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": "http.request"}

    exchange = Exchange(SCOPE, receive, send, 0.05)
    await exchange.hand_to(app, {}, 10, ByteBudget(100))
    assert b"".join(one.get("body", b"") for one in sent) == b"data: 1\n\n"


async def test_another_application_answers_head_without_a_body() -> None:
    asked = Asked()
    await asked.be_asked(asked.send, {"type": "http.request"}, method="HEAD")
    assert b"".join(one.get("body", b"") for one in asked.sent) == b""


async def test_another_application_goes_on_when_its_client_does_not_read() -> None:
    asked = Asked()
    with anyio.fail_after(20):
        await asked.be_asked(deaf, {"type": "http.request"})
    assert asked.received[-1] == {"type": "http.disconnect"}


def asked(**headers: str) -> Exchange:
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    return Exchange(SCOPE | {"headers": raw}, receive, deaf)


@pytest.mark.parametrize(
    ("prefer", "seconds"),
    [
        ("wait=10", 10),
        ("respond-async, wait=10", 10),
        ('Wait="7" ; x=1, respond-async', 7),
        ("wait=9999", 60),
        ("respond-async", None),
        ("wait=soon", None),
        ("await=3", None),
    ],
)
async def test_a_client_may_prefer_to_wait(prefer: str, seconds: float | None) -> None:
    exchange = asked(prefer=prefer)
    assert exchange.wait_wanted(60) == seconds
    told = [] if seconds is None else [("Preference-Applied", f"wait={seconds}")]
    assert exchange.more_headers == told
    exchange.query = {"wait": ["2"]}
    assert exchange.wait_wanted(60) == 2


@pytest.mark.parametrize(
    ("accept", "is_packed"),
    [("gzip", True), ("br, GZIP;q=0.5", True), ("gzip;q=0", False), ("x-gzip", False), ("", False)],
)
@pytest.mark.parametrize("size", [2000, 200_000])
async def test_an_answer_is_compressed_for_a_client_that_takes_it(
    accept: str, is_packed: bool, size: int
) -> None:
    told: dict[bytes, bytes] = {}
    pieces: list[bytes] = []

    async def send(message: Any) -> None:
        told.update(message.get("headers", ()))
        pieces.append(message.get("body", b""))

    exchange = Exchange(SCOPE | {"headers": [(b"accept-encoding", accept.encode())]}, receive, send)
    await exchange.answer_unless_known(bytes(size), '"a"')
    body = b"".join(pieces)
    assert int(told[b"content-length"]) == len(body)
    assert told[b"vary"] == b"Accept-Encoding"
    assert (told.get(b"content-encoding") == b"gzip") is is_packed
    assert told[b"etag"] == (b'W/"a"' if is_packed else b'"a"')
    assert (gzip.decompress(body) if is_packed else body) == bytes(size)


@pytest.mark.parametrize(("status", "has_length"), [(200, True), (404, True), (204, False)])
async def test_an_answer_without_a_body_tells_no_length_of_one(
    status: int, has_length: bool
) -> None:
    told: dict[bytes, bytes] = {}

    async def send(message: Any) -> None:
        told.update(message.get("headers", ()))

    await Exchange(SCOPE, receive, send).answer(status, b"")
    assert (b"content-length" in told) is has_length


async def test_that_a_copy_is_up_to_date_is_told_without_the_length_of_an_empty_body() -> None:
    told: dict[bytes, bytes] = {}

    async def send(message: Any) -> None:
        told.update(message.get("headers", ()))

    exchange = Exchange(SCOPE | {"headers": [(b"if-none-match", b'"a"')]}, receive, send)
    await exchange.answer_unless_known(b"whole", '"a"')
    assert told[b"etag"] == b'"a"'
    assert b"content-length" not in told
