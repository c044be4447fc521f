"""The answers of JetStream, and the consumers of records and notes, without a broker."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import anyio
import msgspec
import pytest

from fibaction import TransportError
from fibaction._runtime.notify import Notifier
from fibaction.border.event_loop import Background
from fibaction_transports.nats.broker.answers import PendingAnswers
from fibaction_transports.nats.broker.broker import (
    BrokerAway,
    BrokerRecord,
    BrokerSubscription,
    Message,
    NoResponders,
    OnMessage,
    PutFailure,
)
from fibaction_transports.nats.broker.client import NatsClient
from fibaction_transports.nats.broker.consumers import HEAD, NoteQueue, RecordWatch, delivery
from fibaction_transports.nats.broker.jetstream import (
    NAME_IN_USE,
    NO_LEADER,
    NO_PEERS,
    NO_ROOM_FOR_REPLICAS,
    STREAM_NOT_FOUND,
    check_account,
    check_version,
    create_streams,
    find_stream,
    outcome,
)
from fibaction_transports.nats.broker.login import BrokerInfo
from fibaction_transports.nats.broker.nats_broker import NatsBroker
from fibaction_transports.nats.names import FleetNames
from fibaction_transports.nats.settings import FleetSettings

pytestmark = pytest.mark.anyio
NAMES = FleetNames("f")


# Answers that a test gives

NO_RESPONDERS = None
"""The answer of nobody."""


def failed(number: int, code: int = 400, text: str = "no") -> dict[str, Any]:
    """An answer with an error of JetStream."""
    return {"error": {"code": code, "err_code": number, "description": text}}


class _Subscribed(BrokerSubscription):
    def close(self) -> None:
        """See `BrokerSubscription.close`."""


class ScriptedClient:
    """The part of `NatsClient` that JetStream needs; each answer is used once, but for the last."""

    url = "nats://broker"
    is_connected = True

    def __init__(self, **answers: Any) -> None:
        """Answer to each request whose subject has this part of the API in it (`_` for the dot)."""
        self.answers = {name.replace("_", "."): list(found) for name, found in answers.items()}
        self.asked: list[tuple[str, Any]] = []
        """The requests, and the messages that were published."""
        self.timeouts: list[float] = []
        """The seconds of each request."""
        self.info = BrokerInfo()
        self.connections = 1
        self.to_notify: set[Notifier] = set()
        self.on_message: OnMessage = lambda _message: None
        self.on_publish: Callable[[str], None] = lambda _subject: None

    def new_inbox(self) -> str:
        return "_INBOX.one"

    async def subscribe(
        self, subject: str, on_message: OnMessage, queue: str = ""
    ) -> BrokerSubscription:
        self.on_message = on_message
        return _Subscribed()

    def publish(self, subject: str, data: bytes, reply: str = "") -> None:
        self.asked.append((subject, data))
        self.on_publish(subject)

    async def answer(self, subject: str, data: bytes, timeout: float) -> Message:
        self.asked.append((subject, msgspec.json.decode(data) if data else None))
        self.timeouts.append(timeout)
        found = next(found for name, found in self.answers.items() if name in subject)
        answer = found.pop(0) if len(found) > 1 else found[0]
        if isinstance(answer, Exception):
            raise answer
        if answer is NO_RESPONDERS:
            raise NoResponders(subject)
        if isinstance(answer, Message):
            return answer
        return Message("", msgspec.json.encode(answer), "", {})

    def bodies(self, name: str) -> list[Any]:
        """The bodies of the requests of one part of the API."""
        return [body for subject, body in self.asked if name in subject]


MISSING = failed(STREAM_NOT_FOUND, 404)
MADE = {"created": "2026-11-26T12:00:00.123456789Z", "ts": "2026-11-26T12:00:07.623456789Z"}


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


def delivered(number: int, pending: int = 0) -> Message:
    return Message("s", b"x", f"$JS.ACK.stream.consumer.1.{number + 6}.{number}.1.{pending}", {})


def control(reply: str = "", **headers: str) -> Message:
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return Message("inbox", b"", reply, {"Status": "100", **named})


@pytest.fixture
def watch() -> RecordWatch:
    """A watch whose consumer is there."""
    made = RecordWatch(NatsClient(FleetSettings("f")), "stream", "s")
    made._is_broken = False
    return made


async def test_a_number_that_is_left_out_breaks_the_consumer(watch: RecordWatch) -> None:
    watch._on_message(delivered(1, 1))
    assert not watch._is_complete
    watch._on_message(delivered(3))
    assert watch._is_broken
    watch._on_message(delivered(2))
    assert watch._records == [BrokerRecord("s", b"x", 7)]


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


async def test_heads_are_complete_though_the_last_records_were_removed_meanwhile() -> None:
    watch = RecordWatch(NatsClient(FleetSettings("f")), "stream", "s", since=0)
    watch._is_broken = False
    headers = {HEAD: base64.b64encode(b"head").decode()}
    watch._on_message(delivered(1, 1)._replace(headers=headers))
    watch._on_message(control(Nats_Consumer_Stalled="stalled"))
    assert not watch._is_complete
    watch._on_message(control(Nats_Last_Consumer="1"))
    assert watch._is_complete
    watch._on_message(control(Nats_Last_Consumer="1"))
    watch._on_message(delivered(2)._replace(headers={HEAD: "?"}))
    assert [record.data for record in watch._records] == [b"head", b""]
    assert not watch._is_broken


async def test_a_consumer_that_is_gone_is_broken(watch: RecordWatch) -> None:
    watch._on_message(Message("inbox", b"", "", {"Status": "409"}))
    assert watch._is_broken
    watch.close()


# The broker and its account


@pytest.mark.parametrize("version", ["2.9.10", "2.10.29", "", "new"])
def test_a_version_that_ignores_leases_is_one_sentence(version: str) -> None:
    with pytest.raises(TransportError) as caught:
        check_version("nats://host", version)
    assert str(caught.value) == (
        f"the broker at nats://host is nats-server {version or 'of no known version'}, and a"
        " fleet needs 2.11 or later: in older ones the lease of a lost worker does not end"
    )


@pytest.mark.parametrize(
    ("info", "text"),
    [
        ({"api": {"level": 0}}, "is older than 2.11: update all brokers"),
        (failed(10039, 503), "cannot be used: no"),
        (Message("", b"no JSON", ""), "does not answer"),
        (NO_RESPONDERS, "is not enabled: start nats-server with -js"),
    ],
)
async def test_an_account_that_cannot_be_used_is_one_sentence(info: Any, text: str) -> None:
    client: Any = ScriptedClient(API_INFO=[info])
    with pytest.raises(TransportError, match=text):
        await check_account(client)


async def test_an_election_is_waited_for_and_not_for_ever(
    no_pause: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = [NO_RESPONDERS, BrokerAway("no answer"), failed(NO_LEADER, 503)]
    client: Any = ScriptedClient(API_INFO=[*away, {"api": {"level": 1}}])
    client.info = BrokerInfo(cluster="c")
    await check_account(client)
    assert len(client.asked) == 4
    monkeypatch.setattr("fibaction_transports.nats.broker.jetstream.ELECTION", 0.05)
    client.answers = {"API.INFO": [NO_RESPONDERS]}
    with pytest.raises(TransportError, match="is not enabled"):
        await check_account(client)


# Answers


async def test_a_lost_connection_fails_what_was_sent_on_it_only() -> None:
    pending = PendingAnswers("inbox")
    told: list[object] = []
    for number in ("1", "2"):
        pending.call_back(number, told.append)
    sent, unsent = pending.expect("3"), pending.expect("4")
    pending.give_up({"2", "4"}, "it was lost")
    assert told == [None]
    with pytest.raises(BrokerAway, match="it was lost"):
        await sent
    assert not unsent.done()
    assert "1" not in pending
    assert "2" in pending


# Streams


@pytest.fixture
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fibaction_transports.nats.broker.jetstream.TRY_AGAIN", 0)


def made(**changes: Any) -> Any:
    """Return an answer with the settings of each stream in turn, or with other ones."""
    shared = {"retention": "limits", "max_msgs_per_subject": 1, "allow_msg_ttl": True}
    notes = {"retention": "workqueue", "subjects": [NAMES.all_want(), NAMES.all_left()]}
    return [
        {"config": {**one, "num_replicas": 1, **changes}}
        for one in (
            {"name": NAMES.goals, "subjects": [NAMES.all_goals()], "max_bytes": 2**30, **shared},
            {"name": NAMES.workers, "subjects": [NAMES.worker()], **shared},
            {"name": NAMES.notes, **notes},
        )
    ]


async def create(client: Any, replicas: int = 0, brokers: int = 1) -> None:
    await create_streams(client, NAMES, replicas, brokers)


async def test_the_replicas_that_are_asked_for_are_given_to_streams_that_are_there() -> None:
    client = ScriptedClient(STREAM_INFO=made(), STREAM_UPDATE=[{}])
    await create(client, replicas=3)
    assert [body["num_replicas"] for body in client.bodies("STREAM.UPDATE")] == [3, 3, 3]
    client = ScriptedClient(STREAM_INFO=made())
    await create(client)
    assert not client.bodies("STREAM.UPDATE")


@pytest.mark.parametrize("number", NO_ROOM_FOR_REPLICAS)
async def test_a_cluster_without_room_for_three_replicas_keeps_one(
    number: int, no_pause: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("fibaction_transports.nats.broker.jetstream.PLACEMENT", 0)
    first, *others = made()
    client = ScriptedClient(
        STREAM_INFO=[MISSING, MISSING, *others], STREAM_CREATE=[failed(number, 503), first]
    )
    await create(client, brokers=3)
    assert [body["num_replicas"] for body in client.bodies("STREAM.CREATE")] == [3, 1]
    assert caplog.messages == [
        f"the stream {NAMES.goals} cannot be made: no; one broker keeps each of its records"
    ]


@pytest.mark.parametrize("replicas", [0, 3])
async def test_replicas_are_placed_when_brokers_that_began_have_heard_of_each_other(
    replicas: int, no_pause: None
) -> None:
    first, *others = made(num_replicas=3)
    alone = failed(NO_PEERS, 400, "no suitable peers for placement")
    client = ScriptedClient(
        STREAM_INFO=[MISSING, MISSING, MISSING, *others], STREAM_CREATE=[alone, alone, first]
    )
    await create(client, replicas, brokers=3)
    assert [body["num_replicas"] for body in client.bodies("STREAM.CREATE")] == [3, 3, 3]


@pytest.mark.parametrize("number", [10047, *NO_ROOM_FOR_REPLICAS])
async def test_of_a_small_storage_the_goals_take_less(number: int, no_pause: None) -> None:
    goals, *others = made()
    goals["config"]["max_bytes"] = 2**28
    full = failed(number, 500, "no suitable peers for placement, insufficient storage")
    client = ScriptedClient(
        STREAM_INFO=[MISSING],
        STREAM_CREATE=[full, full, goals, full, *others],
        STREAM_UPDATE=[{}],
    )
    await create(client, brokers=3)
    sizes = [(one["max_bytes"], one["num_replicas"]) for one in client.bodies("STREAM.CREATE")]
    assert sizes[:3] == [(2**30, 3), (2**29, 3), (2**28, 3)]
    assert sizes[3:] == [(2**23, 3)] * 3
    assert [one["max_bytes"] for one in client.bodies("STREAM.UPDATE")] == [2**27]


@pytest.mark.parametrize("is_made", [True, False])
async def test_a_storage_without_any_room_is_one_sentence(is_made: bool) -> None:
    goals, *_ = made()
    goals["config"]["max_bytes"] = 2**18
    full = failed(10047, 500, "insufficient storage resources available")
    client = ScriptedClient(
        STREAM_INFO=[MISSING], STREAM_CREATE=[goals, full] if is_made else [full]
    )
    name = NAMES.workers if is_made else NAMES.goals
    with pytest.raises(TransportError, match=f"stream {name} cannot be made: insufficient storage"):
        await create(client)
    assert client.bodies("STREAM.CREATE")[-1]["max_bytes"] == 2**18


async def test_a_stream_of_goals_without_a_limit_is_named_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    await create(ScriptedClient(STREAM_INFO=made()))
    assert not caplog.messages
    await create(ScriptedClient(STREAM_INFO=made(max_bytes=-1)))
    assert [message.partition(": ")[0] for message in caplog.messages] == [
        f"the stream {NAMES.goals} has no limit"
    ]


async def test_an_election_is_waited_for_before_streams_are_made(no_pause: None) -> None:
    away = BrokerAway("no answer")
    client = ScriptedClient(STREAM_INFO=[NO_RESPONDERS, away, failed(NO_LEADER, 503), *made()])
    await create(client)
    assert len(client.asked) == 6


async def test_streams_that_nobody_makes_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fibaction_transports.nats.broker.jetstream.ELECTION", 0.05)
    with pytest.raises(TransportError, match="cannot be made: JetStream does not answer"):
        await create(ScriptedClient(STREAM_INFO=[NO_RESPONDERS]))


@pytest.mark.parametrize(
    "answers",
    [{"STREAM_INFO": [failed(1)]}, {"STREAM_INFO": [MISSING], "STREAM_CREATE": [failed(1)]}],
)
async def test_streams_that_cannot_be_made_are_one_sentence(answers: dict[str, Any]) -> None:
    with pytest.raises(TransportError, match=r"the stream .* cannot be made: no"):
        await create(ScriptedClient(**answers))


async def test_a_stream_that_another_worker_makes_first_is_used() -> None:
    first, *others = made()
    client = ScriptedClient(
        STREAM_INFO=[MISSING, first, *others], STREAM_CREATE=[failed(NAME_IN_USE)]
    )
    await create(client)
    assert len(client.bodies("STREAM.CREATE")) == 1


# Records


async def got(brokers: int = 1, **answers: Any) -> BrokerRecord | None:
    broker: NatsBroker = type("", (ScriptedClient, NatsBroker), {})(**answers)
    broker.brokers = brokers
    return await broker.get(NAMES.workers, NAMES.worker("w"))


async def test_a_record_of_a_stream_that_is_missing_is_missing() -> None:
    assert await got(DIRECT_GET=[NO_RESPONDERS], STREAM_MSG_GET=[MISSING]) is None
    assert await got(3, STREAM_MSG_GET=[MISSING]) is None


async def test_a_record_of_a_stream_that_was_just_made_is_asked_of_its_leader() -> None:
    found = {"message": {"data": "YQ==", "seq": 7}}
    record = await got(DIRECT_GET=[NO_RESPONDERS], STREAM_MSG_GET=[found])
    assert record == BrokerRecord(NAMES.worker("w"), b"a", 7)


@pytest.mark.parametrize(
    ("brokers", "answers"),
    [
        (1, {"DIRECT_GET": [NO_RESPONDERS], "STREAM_MSG_GET": [failed(NO_LEADER, 503)]}),
        (1, {"DIRECT_GET": [NO_RESPONDERS], "STREAM_MSG_GET": [NO_RESPONDERS]}),
        (1, {"DIRECT_GET": [Message("", b"", "", {"Status": "408"})]}),
        (3, {"STREAM_MSG_GET": [failed(NO_LEADER, 503)]}),
        (3, {"STREAM_MSG_GET": [NO_RESPONDERS]}),
    ],
)
async def test_a_stream_that_does_not_answer_is_told_from_a_missing_record(
    brokers: int, answers: dict[str, Any]
) -> None:
    with pytest.raises(BrokerAway, match="does not answer"):
        await got(brokers, **answers)


async def test_a_watch_begins_when_the_brokers_answer_again(no_pause: None) -> None:
    consumer = {"num_pending": 0, "delivered": {"consumer_seq": 0}}
    answers = [NO_RESPONDERS, BrokerAway("no answer"), failed(NO_LEADER, 503), consumer]
    client: Any = ScriptedClient(CONSUMER_CREATE=answers)
    watch = RecordWatch(client, "stream", "s")
    assert await watch.next() is None
    assert len([name for name, _ in client.asked if "CREATE" in name]) == len(answers)


async def test_a_consumer_that_was_not_answered_in_time_is_removed(no_pause: None) -> None:
    consumer = {"num_pending": 0, "delivered": {"consumer_seq": 0}}
    client: Any = ScriptedClient(CONSUMER_CREATE=[BrokerAway("no answer"), consumer])
    assert await RecordWatch(client, "stream", "s").next() is None
    made, removed, _ = [name for name, _ in client.asked]
    assert made == "$JS.API.CONSUMER.CREATE.stream.one.s"
    assert removed == "$JS.API.CONSUMER.DELETE.stream.one"


async def test_flow_control_holds_the_broker_back_until_the_reader_comes() -> None:
    client: Any = ScriptedClient(CONSUMER_CREATE=[{"delivered": {"consumer_seq": 0}}])
    watch = RecordWatch(client, "stream", "s")
    assert await watch.next() is None
    client.on_message(control("flow"))
    assert ("flow", b"") not in client.asked
    client.on_message(delivered(1))
    await watch.next()
    assert ("flow", b"") in client.asked


# Notes

NEXT = "CONSUMER.MSG.NEXT"


def note(data: bytes) -> Message:
    return Message("s", data, f"ack.{data.decode()}", {})


@pytest.fixture
def client() -> Any:
    """A connection on which no note comes."""
    return ScriptedClient(CONSUMER_CREATE=[{}])


def answering(client: Any, *answers: Message | None) -> None:
    """Answer to each request for a note in turn; None is another connection."""
    left = list(answers)

    def on_publish(subject: str) -> None:
        if NEXT in subject and left:
            answer = left.pop(0)
            if answer is not None:
                client.on_message(answer)
                return
            client.connections += 1
            for one in client.to_notify:
                one.notify()

    client.on_publish = on_publish


@pytest.mark.parametrize(
    ("answer", "consumers"),
    [
        (Message("", b"", "", {"Status": "404"}), 1),
        (Message("", b"", "", {"Status": "408"}), 1),
        (Message("", b"", "", {"Status": "409"}), 2),
        (None, 2),
    ],
)
async def test_a_consumer_that_is_gone_is_made_again(
    client: Any, answer: Message | None, consumers: int
) -> None:
    answering(client, answer, note(b"one"))
    notes = NoteQueue(client, NAMES.want("a")).notes()
    assert (await anext(notes)).data == b"one"
    assert len(client.bodies("CONSUMER.CREATE")) == consumers
    await notes.aclose()


async def test_brokers_without_a_leader_are_soon_asked_again_for_notes(no_pause: None) -> None:
    client: Any = ScriptedClient(CONSUMER_CREATE=[BrokerAway("no answer")] * 4 + [{}])
    answering(client, note(b"one"))
    notes = NoteQueue(client, NAMES.want("a")).notes()
    assert (await anext(notes)).data == b"one"
    assert client.timeouts == [1, 2, 4, 5, 5]
    await notes.aclose()


async def test_a_note_that_nobody_has_taken_is_given_back(client: Any) -> None:
    notes = NoteQueue(client, NAMES.want("a")).notes()

    def on_publish(subject: str) -> None:
        if NEXT in subject:
            client.on_message(note(b"one"))
            client.on_message(note(b"late"))

    client.on_publish = on_publish
    (await anext(notes)).done()
    await notes.aclose()
    assert client.asked[-2:] == [("ack.one", b"+ACK"), ("ack.late", b"-NAK")]


@pytest.mark.parametrize(
    "next_of",
    [
        lambda client: RecordWatch(client, "stream", "s").next(),
        lambda client: anext(NoteQueue(client, NAMES.want("a")).notes()),
    ],
)
async def test_a_reader_waits_for_the_connection(next_of: Callable[[Any], Any]) -> None:
    client: Any = ScriptedClient(CONSUMER_CREATE=[{"delivered": {"consumer_seq": 0}}])
    answering(client, note(b"one"))
    client.is_connected = False
    with anyio.move_on_after(0):
        await next_of(client)
    async with Background() as tasks:
        tasks.start_soon(next_of, client)
        await anyio.wait_all_tasks_blocked()
        assert not client.asked
        client.is_connected = True
        for one in client.to_notify:
            one.notify()
        await anyio.wait_all_tasks_blocked()
    assert client.asked


# Streams that are looked for


@pytest.mark.parametrize("answer", [failed(NO_LEADER, 503), NO_RESPONDERS])
async def test_a_stream_that_does_not_answer_is_not_missing(answer: Any) -> None:
    client: Any = ScriptedClient(STREAM_INFO=[answer])
    with pytest.raises(BrokerAway):
        await find_stream(client, NAMES.goals)
