"""The identity of requests in the ways of both vendors."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from fibaction import ConnectionLost
from fibaction.words.errors import LimitReached
from fibaction_transports.ros2.on_dds.services import (
    ANSWERED_REQUESTS,
    OPEN_REQUESTS,
    DdsCaller,
    DdsProvider,
    ServiceEnds,
    client_of,
    identity_in,
    identity_items,
    split_header,
)
from fibaction_transports.ros2.without_ros.messages.message_type import ServiceType
from fibaction_transports.ros2.without_ros.messages.node_messages import (
    GET_PARAMETERS,
    NamesRequest,
    ValuesResponse,
)
from fibaction_transports.rtps.endpoints.sample import Sample
from fibaction_transports.rtps.messages.ids import CYCLONE_DDS, FAST_DDS, OWN_VENDOR, Guid
from fibaction_transports.rtps.messages.parameters import Parameters, SampleIdentity

FAST, CYCLONE, OWN = (bytes([number]) * 12 for number in (1, 2, 3))
VENDORS = {FAST: FAST_DDS, CYCLONE: CYCLONE_DDS}
READER, WRITER = b"\0\0\1\4", b"\0\0\2\3"


def reader_of(prefix: bytes) -> Guid:
    return Guid(prefix + READER)


def writer_of(prefix: bytes) -> Guid:
    return Guid(prefix + WRITER)


class Sent(msgspec.Struct, eq=False):
    payload: bytes
    inline_qos: Any = ()
    only_to: Guid | None = None


class Network:
    """What an end of a service sends, without a network."""

    def __init__(self, *others: bytes) -> None:
        self.sent: list[Sent] = []
        self.is_full = False
        self.participant = SimpleNamespace(vendor_of=VENDORS.get)
        self.answered: list[tuple[bytes, int]] = []
        writer = SimpleNamespace(
            guid=writer_of(OWN),
            topic="requests",
            matched=[reader_of(one) for one in others],
            receive_answer=lambda *answer: self.answered.append(answer[:2]),
        )
        reader = SimpleNamespace(
            guid=reader_of(OWN),
            topic="replies",
            confirmed_writers=[writer_of(one) for one in others],
        )
        self.ends: Any = ServiceEnds(self, writer, reader)  # type: ignore[arg-type]  # stand-ins

    def write(self, writer: Any, payload: bytes, **settings: Any) -> int:
        if self.is_full:
            raise LimitReached("full")
        self.sent.append(Sent(payload, **settings))
        return len(self.sent)


class Client(Network):
    def __init__(self, *servers: bytes) -> None:
        super().__init__(*servers)
        self.answers: list[tuple[int, list[int]]] = []
        self.errors: list[str] = []
        self.caller = DdsCaller(
            self.ends,
            GET_PARAMETERS,
            lambda number, response: self.answers.append(
                (number, [value.type for value in response.values])
            ),
            lambda error: self.errors.append(str(error)),
        )

    def answer(self, server: bytes, sent: Sent, payload: bytes) -> None:
        """Let a server answer a request in the way of its vendor."""
        if server == CYCLONE:
            header = sent.payload[4:20]
            sample = Sample(writer_of(server), 1, payload[:4] + header + payload[4:])
        else:
            number = self.sent.index(sent) + 1
            related = identity_items(SampleIdentity(reader_of(OWN), number))
            sample = Sample(writer_of(server), 1, payload, Parameters(tuple(related)))
        self.caller.receive(sample)


REQUEST = NamesRequest(["a"])
RESPONSE = GET_PARAMETERS.Response.codec.encode(ValuesResponse([]))


@pytest.fixture(params=["asyncio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


pytestmark = pytest.mark.anyio


async def test_servers_of_one_vendor_get_one_sample() -> None:
    client = Client(FAST, OWN)
    assert client.caller.send(REQUEST) == 1
    (sent,) = client.sent
    assert sent.only_to is None
    assert sent.payload == GET_PARAMETERS.Request.codec.encode(REQUEST)
    client.answer(FAST, sent, RESPONSE)
    assert client.answers == [(1, [])]
    assert client.answered == [(FAST, 1)]  # which acknowledges the request


async def test_servers_with_a_header_get_it_ahead_of_the_message() -> None:
    client = Client(CYCLONE)
    assert client.caller.send(REQUEST) == 1
    assert client.caller.send(REQUEST) == 2
    plain = GET_PARAMETERS.Request.codec.encode(REQUEST)
    assert [(one.payload[:4] + one.payload[20:], one.inline_qos) for one in client.sent] == [
        (plain, ())
    ] * 2
    assert [struct.unpack("<q", one.payload[12:20])[0] for one in client.sent] == [1, 2]
    client.answer(CYCLONE, client.sent[1], RESPONSE)
    assert client.answers == [(2, [])]


async def test_servers_of_both_vendors_get_a_sample_each_and_the_number_of_the_call_is_one() -> (
    None
):
    client = Client(CYCLONE, FAST)
    assert client.caller.send(REQUEST) == 1
    with_header, plain = client.sent
    assert (with_header.only_to, plain.only_to) == (reader_of(CYCLONE), reader_of(FAST))
    client.answer(FAST, plain, RESPONSE)
    client.answer(CYCLONE, with_header, RESPONSE)
    assert client.answers == [(1, []), (1, [])]


async def test_an_answer_for_another_client_is_left_alone() -> None:
    client = Client(CYCLONE, FAST)
    client.caller.send(REQUEST)
    other = Guid(b"\4" * 12 + READER)
    foreign = [
        Sample(writer_of(FAST), 1, RESPONSE),
        Sample(
            writer_of(FAST),
            1,
            RESPONSE,
            Parameters(tuple(identity_items(SampleIdentity(other, 2)))),
        ),
        Sample(
            writer_of(FAST),
            1,
            RESPONSE,
            Parameters(tuple(identity_items(SampleIdentity(reader_of(OWN), 99)))),
        ),
        Sample(writer_of(CYCLONE), 1, RESPONSE[:4] + bytes(16) + RESPONSE[4:]),
        Sample(writer_of(CYCLONE), 1, RESPONSE[:4]),
    ]
    for sample in foreign:
        client.caller.receive(sample)
    assert client.answers == []


async def test_an_answer_that_cannot_be_read_is_told(caplog: pytest.LogCaptureFixture) -> None:
    client = Client(FAST)
    client.caller.send(REQUEST)
    client.answer(FAST, client.sent[0], RESPONSE[:6])
    assert "GetParameters_Response" in client.errors[0]
    assert "an answer on replies cannot be read" in caplog.text
    silent = DdsCaller(client.ends, GET_PARAMETERS, lambda number, response: None, None)
    silent.send(REQUEST)
    related = Parameters(tuple(identity_items(SampleIdentity(reader_of(OWN), 2))))
    silent.receive(Sample(writer_of(FAST), 1, RESPONSE[:6], related))


async def test_a_request_that_nobody_takes_ends_with_an_error() -> None:
    client = Client(FAST)
    client.is_full = True
    with pytest.raises(ConnectionLost, match="requests is not read: full"):
        client.caller.send(REQUEST)


async def test_requests_that_are_never_answered_are_forgotten() -> None:
    client = Client(FAST)
    for _ in range(OPEN_REQUESTS + 1):
        client.caller.send(REQUEST)
    first, *_, last = client.sent
    for sent in (first, last):
        client.answer(FAST, sent, RESPONSE)
    assert client.answers == [(OPEN_REQUESTS + 1, [])]


async def test_of_answered_requests_only_the_newest_wait_for_answers_of_other_servers() -> None:
    client = Client(FAST, OWN)
    for _ in range(ANSWERED_REQUESTS + 1):
        client.caller.send(REQUEST)
        client.answer(FAST, client.sent[-1], RESPONSE)
    assert len(client.answers) == ANSWERED_REQUESTS + 1
    assert len(client.caller._of_sample) == ANSWERED_REQUESTS
    client.answers.clear()
    for sent in (client.sent[0], client.sent[1], client.sent[-1]):
        client.answer(OWN, sent, RESPONSE)
    assert client.answers == [(2, []), (ANSWERED_REQUESTS + 1, [])]


async def test_a_service_is_available_if_one_server_has_both_of_its_ends() -> None:
    client = Client(FAST)
    assert client.caller.is_available()
    client.ends.reader.confirmed_writers = [writer_of(CYCLONE)]
    assert not client.caller.is_available()


class Server(Network):
    def __init__(self, *clients: bytes, service_type: ServiceType = GET_PARAMETERS) -> None:
        super().__init__(*clients)
        self.requests: list[tuple[Any, Any]] = []
        self.provider = DdsProvider(
            self.ends, service_type, lambda *request: self.requests.append(request)
        )

    def request(self, client: bytes, number: int = 7) -> None:
        """Take a request of a client in the way of its vendor."""
        payload = GET_PARAMETERS.Request.codec.encode(REQUEST)
        if client == CYCLONE:
            self.provider.receive(
                Sample(writer_of(client), number, payload[:4] + b"h" * 16 + payload[4:])
            )
            return
        items = identity_items(SampleIdentity(reader_of(client), -(2**32)))
        self.provider.receive(Sample(writer_of(client), number, payload, Parameters(tuple(items))))


def test_each_client_is_answered_in_its_own_way_and_alone() -> None:
    server = Server(FAST, CYCLONE)
    server.request(FAST)
    server.request(CYCLONE)
    for header, request in server.requests:
        assert request == REQUEST
        assert server.provider.answer(header, ValuesResponse([]))
    to_fast, to_cyclone = server.sent
    assert (to_fast.only_to, to_fast.payload) == (reader_of(FAST), RESPONSE)
    (pid, value), *_ = to_fast.inline_qos
    related = Parameters(((pid, value),)).identity(pid)
    assert related == SampleIdentity(reader_of(FAST), 7)
    assert (to_cyclone.only_to, to_cyclone.inline_qos) == (reader_of(CYCLONE), ())
    assert split_header(to_cyclone.payload) == (b"h" * 16, RESPONSE)


@pytest.mark.parametrize("client", [FAST, CYCLONE])
def test_an_answer_whose_client_is_not_matched_yet_cannot_be_sent(client: bytes) -> None:
    server = Server()
    server.request(client)
    ((header, _),) = server.requests
    assert not server.provider.answer(header, ValuesResponse([]))
    assert server.sent == []


def test_a_request_that_cannot_be_read_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    server = Server(FAST, CYCLONE)
    items = identity_items(SampleIdentity(reader_of(FAST), -(2**32)))
    for sample in (
        Sample(writer_of(FAST), 1, RESPONSE),
        Sample(writer_of(CYCLONE), 1, RESPONSE),
        Sample(writer_of(FAST), 1, b"\0\1\0\0\1", Parameters(tuple(items))),
    ):
        server.provider.receive(sample)
    assert server.requests == []
    assert caplog.text.count("a request on replies does not name its client") == 2
    assert "a request on replies cannot be read" in caplog.text


def test_a_sample_without_inline_qos_has_no_identity() -> None:
    assert identity_in(Sample(writer_of(FAST), 1, RESPONSE)) is None
    assert identity_in(Sample(writer_of(FAST), 1, RESPONSE, Parameters(()))) is None


def test_clients_have_ids_of_their_own_in_headers() -> None:
    prefixes = [OWN_VENDOR + bytes([0, 0, 0, 0, 0, last, 0, 0, 0, 0]) for last in range(2)]
    readers = [Guid(prefix + READER) for prefix in prefixes]
    readers += [Guid(prefixes[0] + b"\0" + number + b"\4") for number in (b"\0\2", b"\1\1")]
    found = {client_of(reader) for reader in readers}
    assert len(found) == len(readers)
    assert {len(each) for each in found} == {8}
