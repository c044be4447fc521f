"""The answers of JetStream, and the consumers of records and notes, without a broker."""

from __future__ import annotations

import msgspec
import pytest

from fibaction_transports.nats.broker import PutFailure, Record
from fibaction_transports.nats.fleet_settings import FleetSettings
from fibaction_transports.nats.jetstream import outcome
from fibaction_transports.nats.nats_answers import RawMessage
from fibaction_transports.nats.nats_client import NatsClient
from fibaction_transports.nats.record_watch import RecordWatch, delivery


@pytest.mark.parametrize(
    ("code", "number", "kind"),
    [
        (400, 10071, PutFailure.REFUSED),
        (400, 10164, PutFailure.REFUSED),
        (400, 10054, PutFailure.TOO_LARGE),
        (503, 10008, PutFailure.UNKNOWN),
        (503, 10077, PutFailure.FULL),
        (400, 10999, PutFailure.FULL),
    ],
)
def test_an_error_of_a_write_is_of_a_kind(code: int, number: int, kind: PutFailure) -> None:
    error = {"code": code, "err_code": number, "description": "no"}
    assert outcome(msgspec.json.encode({"error": error})) == (kind, "no")


def test_an_answer_to_a_write_has_the_sequence_or_cannot_be_read() -> None:
    assert outcome(b'{"stream": "s", "seq": 7}') == 7
    failed = outcome(b"no JSON")
    assert isinstance(failed, tuple)
    assert failed.kind is PutFailure.UNKNOWN


def test_the_subject_of_a_delivery_is_read_with_and_without_an_account() -> None:
    assert delivery("$JS.ACK.stream.consumer.1.7.3.1700.2") == (7, 3, 2)
    assert delivery("$JS.ACK.domain.hash.stream.consumer.1.7.3.1700.2.x") == (7, 3, 2)


def delivered(number: int, pending: int = 0) -> RawMessage:
    return RawMessage("s", b"x", f"$JS.ACK.stream.consumer.1.{number + 6}.{number}.1.{pending}", {})


def control(reply: str = "", **headers: str) -> RawMessage:
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return RawMessage("inbox", b"", reply, {"Status": "100", **named})


@pytest.fixture
def watch() -> RecordWatch:
    """A watch whose consumer is there."""
    made = RecordWatch(NatsClient(FleetSettings("f")), "stream", "s")
    made._is_broken = False
    return made


@pytest.mark.asyncio
async def test_a_number_that_is_left_out_breaks_the_consumer(watch: RecordWatch) -> None:
    watch._on_message(delivered(1, 1))
    assert not watch._is_complete
    watch._on_message(delivered(3))
    assert watch._is_broken
    watch._on_message(delivered(2))
    assert watch._records == [Record("s", b"x", 7)]


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("last", "is_broken"),
    [({}, False), ({"Nats_Last_Consumer": "1"}, False), ({"Nats_Last_Consumer": "2"}, True)],
)
async def test_a_heartbeat_tells_of_records_that_did_not_come(
    watch: RecordWatch, last: dict[str, str], is_broken: bool
) -> None:
    watch._on_message(delivered(1))
    watch._on_message(control(**last))
    assert watch._is_broken is is_broken


@pytest.mark.asyncio
async def test_flow_control_is_answered_when_records_are_taken(watch: RecordWatch) -> None:
    watch._on_message(control("flow"))
    watch._on_message(control(Nats_Consumer_Stalled="stalled"))
    assert watch._flow == ["flow", "stalled"]


@pytest.mark.asyncio
async def test_a_consumer_that_is_gone_is_broken(watch: RecordWatch) -> None:
    watch._on_message(RawMessage("inbox", b"", "", {"Status": "409"}))
    assert watch._is_broken
    watch.close()
