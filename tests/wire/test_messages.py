from __future__ import annotations

import gc
import math
import tracemalloc
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given, strategies
from hypothesis.strategies import SearchStrategy
from msgspec import inspect

from fibaction.wire.messages import (
    VERSION,
    CancelGoals,
    Ended,
    Failed,
    Feedback,
    FeedbackBatch,
    Follow,
    Following,
    FromClient,
    FromServer,
    GoalChanged,
    Goodbye,
    Hello,
    Logged,
    Operate,
    Operated,
    Ping,
    Rejected,
    RunsAgain,
    SendGoal,
    WatchStatus,
    Welcome,
    Why,
    decode_from_client,
    decode_from_server,
    encode,
    label_fields,
    labels_from,
    past_fields,
    past_from,
    told_labels,
    word_fields,
)
from fibaction.words.errors import ProtocolError
from fibaction.words.goal_query import GoalQuery, PastPage
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus
from tests.support.golden import GOLDEN

CLIENTS: tuple[type, ...] = get_args(FromClient)
SERVERS: tuple[type, ...] = get_args(FromServer)
DECODERS = [decode_from_client, decode_from_server]

by_type = pytest.mark.parametrize(
    ("message", "golden"), GOLDEN, ids=[type(message).__name__ for message, _ in GOLDEN]
)
either_decoder = pytest.mark.parametrize("decode", DECODERS, ids=["client's", "server's"])


def decoders_of(message: object) -> list[Callable[[bytes], Any]]:
    """Those of the sides that may say it."""
    directions = zip((CLIENTS, SERVERS), DECODERS, strict=True)
    return [decode for types, decode in directions if type(message) in types]


def fields(message: object) -> list[Any]:
    """The array that a message is sent as."""
    array = msgspec.msgpack.decode(encode(message))
    assert isinstance(array, list)
    return array


def packed(*items: object) -> bytes:
    return msgspec.msgpack.encode(items)


# The format


@by_type
def test_a_message_has_the_bytes_that_it_always_had(
    message: FromClient | FromServer, golden: str
) -> None:
    assert encode(message).hex() == golden
    for decode in decoders_of(message):
        assert decode(bytes.fromhex(golden)) == message


def test_the_table_has_every_message_once_in_the_order_of_the_tags() -> None:
    types = [type(message) for message, _ in GOLDEN]
    assert len(types) == len(set(types))
    assert set(types) == {*CLIENTS, *SERVERS}
    tags = [fields(message)[0] for message, _ in GOLDEN]
    assert tags == sorted(tags)


def test_both_sides_may_give_a_sign_of_life_and_say_goodbye_and_share_nothing_else() -> None:
    assert {*CLIENTS} & {*SERVERS} == {Ping, Goodbye}


@by_type
def test_what_one_side_says_the_other_may_not(
    message: FromClient | FromServer, golden: str
) -> None:
    for decode in DECODERS:
        if decode not in decoders_of(message):
            with pytest.raises(ProtocolError, match=r"^invalid (client|server) message: "):
                decode(bytes.fromhex(golden))


def test_the_reasons_have_the_numbers_that_they_always_had() -> None:
    assert {name: value for name, value in vars(Why).items() if name.isupper()} == {
        "UNKNOWN_GOAL": 1,
        "SERVER_NOT_FOUND": 2,
        "CONNECTION_LOST": 3,
        "FORBIDDEN": 4,
        "LIMIT": 5,
        "PROTOCOL": 6,
        "TRANSPORT": 7,
        "SERVER_FAILED": 8,
        "INVALID_MESSAGE": 9,
        "INVALID_URL": 10,
    }


@by_type
def test_the_garbage_collector_need_not_look_at_a_message(
    message: FromClient | FromServer, golden: str
) -> None:
    for decode in decoders_of(message):
        assert not gc.is_tracked(decode(bytes.fromhex(golden)))


def test_statuses_and_goal_ids_are_sent_as_plain_numbers_and_bytes() -> None:
    goal_id = GoalID(bytes(range(16)))
    assert fields(GoalChanged(1, goal_id, 2, GoalStatus.CANCELING, 0)) == [
        *(40, 1, bytes(range(16)), 2, 3, 0, 0, "", 0, 0, 1, None, None, None, "", None, "")
    ]


def test_a_message_of_anything_else_is_rejected() -> None:
    with pytest.raises(TypeError, match=r"^a message cannot contain a complex$"):
        encode(Rejected(1, 1j))  # type: ignore[arg-type]  # that is what is refused


def test_no_token_can_be_read_in_a_log() -> None:
    hello = Hello(VERSION, 1.0, "sesame")
    assert repr(hello) == str(hello) == f"Hello(version={VERSION})"


# Every message comes back

TEXT = strategies.text()
BYTES = strategies.binary()
FLOATS = strategies.floats(allow_nan=False)
NUMBERS = strategies.integers(-(2**63), 2**64 - 1)
ANY = strategies.recursive(
    strategies.none() | strategies.booleans() | NUMBERS | FLOATS | TEXT | BYTES,
    lambda inner: strategies.lists(inner) | strategies.dictionaries(TEXT, inner),
    max_leaves=10,
)


def values_of(kind: inspect.Type) -> SearchStrategy[Any]:
    """Any values of a type, within its limits."""
    match kind:
        case inspect.IntType(ge=least, le=most, lt=end):
            most = (end or 2**64) - 1 if most is None else most
            return strategies.integers(-(2**63) if least is None else least, most)
        case inspect.FloatType(gt=None, ge=least, le=most):
            return strategies.floats(least, most)
        case inspect.FloatType(gt=least, le=most):
            return strategies.floats(least, most, exclude_min=True)
        case inspect.StrType():
            return TEXT
        case inspect.BytesType(min_length=least, max_length=most):
            return strategies.binary(min_size=least or 0, max_size=most)
        case inspect.EnumType(cls=cls):
            return strategies.sampled_from(cls)
        case inspect.BoolType():
            return strategies.booleans()
        case inspect.NoneType():
            return strategies.none()
        case inspect.UnionType(types=types):
            return strategies.one_of(*map(values_of, types))
        case inspect.ListType(item_type=item, min_length=least, max_length=most):
            return strategies.lists(values_of(item), min_size=least or 0, max_size=most or 3)
        case inspect.TupleType(item_types=items):
            return strategies.tuples(*map(values_of, items))
        case inspect.DictType(key_type=key, value_type=value):
            return strategies.dictionaries(values_of(key), values_of(value), max_size=3)
        case inspect.StructType(cls=cls, fields=fields):
            return strategies.builds(cls, *(values_of(field.type) for field in fields))
        case _:
            assert isinstance(kind, inspect.AnyType)
            return ANY


@by_type
@given(strategies.data())
def test_a_message_comes_back_as_it_was(
    message: FromClient | FromServer, golden: str, data: strategies.DataObject
) -> None:
    sent = data.draw(values_of(inspect.type_info(type(message))))
    for decode in decoders_of(message):
        received = decode(encode(sent))
        assert type(received) is type(sent)
        assert received == sent


# Newer and older peers


@given(strategies.lists(ANY, min_size=1, max_size=3))
def test_fields_of_a_newer_peer_are_ignored(extra: list[Any]) -> None:
    for message, _ in GOLDEN:
        array = fields(message)
        assert len(array) == 1 + len(message.__struct_fields__)  # also what has a default is sent
        for decode in decoders_of(message):
            assert decode(packed(*array, *extra)) == message


@by_type
def test_fields_that_an_older_peer_does_not_send_get_their_default(
    message: FromClient | FromServer, golden: str
) -> None:
    array = fields(message)
    defaults = message.__struct_defaults__
    required = len(array) - len(defaults)
    names = message.__struct_fields__
    for decode in decoders_of(message):
        for length in range(1, len(array)):
            if length < required:
                with pytest.raises(ProtocolError):
                    decode(packed(*array[:length]))
            else:
                old = decode(packed(*array[:length]))
                sent = length - 1
                expected = [getattr(message, name) for name in names[:sent]]
                expected += defaults[length - required :]
                assert [getattr(old, name) for name in names] == expected


def test_a_client_ignores_messages_of_a_newer_kind_and_no_others() -> None:
    for newer in (packed(51), packed(200, 3, "more", {"any": b"thing"}), packed(2**40, None)):
        assert decode_from_server(newer) == Ping()
        with pytest.raises(ProtocolError):
            decode_from_client(newer)
    wrong = [packed(47), packed(16, 1, 1.0), packed(48), packed(-49), packed("49"), packed()]
    for frame in [*wrong, b"", b"\x91", packed(49)[:-1], packed(49) + b"!", b"\x81\x31\x31"]:
        with pytest.raises(ProtocolError, match="invalid server message"):
            decode_from_server(frame)


# Limits, field by field, as `docs/protocol.md` has them

LARGEST = 2**63 - 1
LIMITS = {
    **dict.fromkeys(["id", "stamp", "after", "place", "number"], (0, LARGEST)),
    **dict.fromkeys(["dropped", "feedback_count", "known", "queue_length"], (0, LARGEST)),
    **dict.fromkeys(["ended_at", "at"], (0, LARGEST)),
    **dict.fromkeys(["credit", "count", "most", "newest"], (0, 2**31 - 1)),
    "attempt": (1, LARGEST),
    "status": (0, 6),
    "return_code": (0, 3),
    "max_frame": (1, 2**32 - 1),
}
"""The least and the largest number that a field takes, by the field's name."""
NULLABLE = {
    (SendGoal, "credit"),
    (SendGoal, "timeout"),
    (SendGoal, "meta"),
    (Follow, "after"),
    (Follow, "credit"),
    (CancelGoals, "goal_id"),
    (CancelGoals, "stamp"),
    (Operate, "mode"),
    (RunsAgain, "new_id"),
    (Logged, "lines"),
    (Ended, "result"),
    (Ended, "ended_at"),
    (Feedback, "at"),
    (FeedbackBatch, "times"),
    (Following, "goal"),
    (Following, "parent"),
    (Following, "labels"),
    (Following, "checkpoint"),
    (Operated, "schedule"),
    (GoalChanged, "parent"),
    (GoalChanged, "began_at"),
    (GoalChanged, "labels"),
    (WatchStatus, "past"),
    (WatchStatus, "labels"),
    (WatchStatus, "words"),
    (GoalChanged, "ended_at"),
}


def with_field(message: FromClient | FromServer, name: str, value: object) -> bytes:
    """What would be sent if a field had another value."""
    array = fields(message)
    array[1 + message.__struct_fields__.index(name)] = value
    return packed(*array)


def taken(message: FromClient | FromServer, name: str, value: object) -> bool:
    """Whether those that the message is for take that value of a field."""
    answers = set()
    for decode in decoders_of(message):
        try:
            received = decode(with_field(message, name, value))
        except ProtocolError:
            answers.add(False)
        else:
            assert getattr(received, name) == value
            answers.add(True)
    (answer,) = answers
    return answer


def fields_named(names: Iterable[str]) -> list[tuple[FromClient | FromServer, str]]:
    """Each field of that name, with a message that has it."""
    return [
        (message, name)
        for message, _ in GOLDEN
        for name in message.__struct_fields__
        if name in names
    ]


def test_every_number_has_limits_but_versions_and_reasons() -> None:
    numbers = {
        (type(message), name)
        for message, _ in GOLDEN
        for name in message.__struct_fields__
        if type(getattr(message, name)) is int
    }
    limited = {(type(message), name) for message, name in fields_named(LIMITS)}
    assert numbers - limited == {
        *(
            (Goodbye, "why"),
            (Failed, "why"),
            (Rejected, "code"),
            (Hello, "version"),
            (Welcome, "version"),
        )
    }


@pytest.mark.parametrize(("message", "name"), fields_named(LIMITS))
def test_a_number_is_taken_exactly_within_its_limits(
    message: FromClient | FromServer, name: str
) -> None:
    least, largest = LIMITS[name]
    assert taken(message, name, least)
    assert taken(message, name, largest)
    assert not taken(message, name, least - 1)
    assert not taken(message, name, largest + 1)


@pytest.mark.parametrize(("message", "name"), fields_named(["heartbeat"]))
def test_a_heartbeat_is_more_than_no_time_and_at_most_an_hour(
    message: FromClient | FromServer, name: str
) -> None:
    assert taken(message, name, 5e-324)
    assert taken(message, name, 3600.0)
    assert not taken(message, name, 0.0)
    assert not taken(message, name, math.nextafter(3600.0, math.inf))


@pytest.mark.parametrize(("message", "name"), fields_named(["timeout"]))
def test_a_timeout_is_more_than_no_time_and_finite(
    message: FromClient | FromServer, name: str
) -> None:
    assert taken(message, name, 5e-324)
    assert taken(message, name, 1e9)
    assert taken(message, name, 5)
    for wrong in (0.0, -1.0, math.nextafter(1e9, math.inf), math.inf, math.nan, "5"):
        assert not taken(message, name, wrong)


@pytest.mark.parametrize(("message", "name"), fields_named(["goal_id"]))
def test_a_goal_id_has_sixteen_bytes(message: FromClient | FromServer, name: str) -> None:
    assert taken(message, name, bytes(16))
    assert not taken(message, name, bytes(15))
    assert not taken(message, name, bytes(17))


@by_type
def test_nil_is_taken_exactly_where_it_means_something(
    message: FromClient | FromServer, golden: str
) -> None:
    for name in message.__struct_fields__:
        assert taken(message, name, None) == ((type(message), name) in NULLABLE)


# What is no message


@either_decoder
@pytest.mark.parametrize("value", [None, 0, "Ping", b"\x91\0", {"0": 0}, 1.0])
def test_what_is_no_array_is_no_message(decode: Callable[[bytes], Any], value: object) -> None:
    with pytest.raises(ProtocolError):
        decode(msgspec.msgpack.encode(value))


@by_type
def test_half_a_message_and_two_messages_are_none(
    message: FromClient | FromServer, golden: str
) -> None:
    data = bytes.fromhex(golden)
    for decode in decoders_of(message):
        for length in range(len(data)):
            with pytest.raises(ProtocolError):
                decode(data[:length])
        with pytest.raises(ProtocolError):
            decode(data + data)


def test_text_that_is_no_utf_8_is_rejected() -> None:
    with pytest.raises(ProtocolError, match=r"(?i)utf-8"):
        decode_from_client(b"\x92\x01\xa1\xff")
    with pytest.raises(ProtocolError, match=r"(?i)utf-8"):
        decode_from_server(b"\x92\x01\xa1\xff")


# Any bytes


def check(data: bytes) -> None:
    """Either a message or a ProtocolError; what is a message can be sent on."""
    for decode in DECODERS:
        with suppress(ProtocolError):
            message = decode(data)
            assert type(message) in {*CLIENTS, *SERVERS}
            assert decode(encode(message)) is not None


@given(strategies.integers(0, 48), strategies.lists(ANY, max_size=7))
def test_any_array_is_a_message_or_a_protocol_error(tag: int, items: list[Any]) -> None:
    check(packed(tag, *items))


@by_type
def test_a_message_with_one_bit_flipped_is_a_message_or_a_protocol_error(
    message: FromClient | FromServer, golden: str
) -> None:
    data = bytes.fromhex(golden)
    for place in range(len(data)):
        for bit in range(8):
            check(data[:place] + bytes([data[place] ^ (1 << bit)]) + data[place + 1 :])


# What would cost a careless decoder much. The map is that of an `ActionInfo` whose schemas hold
# anything.
IN_A_SCHEMA = b"\x93\x2b\x06\x91\x82\xa4name\xa1a\xa4goal\x81\xa1k"


@pytest.mark.parametrize(
    "start",
    [
        *(b"", b"\x92\x01", b"\x93\x29\x05", b"\x93\x16\x05"),
        *(b"\x95\x27\x03\0", b"\x93\x2b\x06", IN_A_SCHEMA),
    ],
    ids=[
        *("outermost", "text", "ignored, of a server", "ignored, of a client"),
        *("goals", "actions", "schema"),
    ],
)
@pytest.mark.parametrize(
    "nested",
    [b"\x91", b"\x81\xa1a", b"\x81", b"\xdd\0\0\0\1", b"\xdf\0\0\0\1\xa1a"],
    ids=["arrays", "maps", "keys", "long arrays", "long maps"],
)
def test_deep_nesting_is_a_protocol_error(start: bytes, nested: bytes) -> None:
    for decode in DECODERS:
        with pytest.raises(ProtocolError):
            decode(start + nested * 200_000)


@pytest.mark.parametrize(
    ("decode", "start"),
    [(decode_from_client, b"\x93\x16\x05"), (decode_from_server, IN_A_SCHEMA)],
    ids=["ignored", "schema"],
)
def test_100_levels_of_nesting_are_read(decode: Any, start: bytes) -> None:
    decode(start + b"\x91" * 100 + b"\xc0")


@pytest.mark.parametrize(
    "start",
    [
        *(b"", b"\x92\x01", b"\x93\x29\x05", b"\x96\x26\x01\x04"),
        *(b"\x95\x27\x03\0", b"\x95\x27\x03\0\x91", b"\x93\x2b\x06", b"\x93\x2b\x06\x91"),
        *(IN_A_SCHEMA, IN_A_SCHEMA + b"\x81", b"\x96\x11\x01\xa1a", b"\x96\x11\x01\xa1a\xc4\x10"),
    ],
    ids=[
        *("outermost", "text", "ignored", "result"),
        *("goals", "goal", "actions", "action"),
        *("schema", "key", "goal ID", "in a goal ID"),
    ],
)
@pytest.mark.parametrize(
    "announced",
    [b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"],
    ids=["array", "map", "text", "bytes", "extension"],
)
def test_a_length_that_is_only_announced_takes_no_memory(start: bytes, announced: bytes) -> None:
    for decode in DECODERS:
        for length in (b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\xff\xff\xff"):
            tracemalloc.start()
            try:
                with pytest.raises(ProtocolError):
                    decode(start + announced + length + b"\0" * 10)
                assert tracemalloc.get_traced_memory()[1] < 2**18
            finally:
                tracemalloc.stop()


@pytest.mark.parametrize(
    "page",
    [
        PastPage(),
        PastPage(
            GoalQuery(frozenset([GoalStatus.SUCCEEDED, GoalStatus.ABORTED]), "robot", 5, 9),
            *(7, (6, bytes(15) + b"\1"), False),
        ),
        PastPage(GoalQuery(labels=(("order", "17"), ("site", "")))),
        PastPage(GoalQuery(words=("gripper", "north"))),
    ],
)
def test_a_page_is_asked_for_as_it_was_given(page: PastPage) -> None:
    assert past_from(past_fields(page), label_fields(page), word_fields(page)) == page


def test_of_labels_that_no_goal_can_have_all_as_many_are_asked_for_as_a_goal_can_have() -> None:
    labels = tuple(("order", str(number)) for number in range(9))
    fields = label_fields(PastPage(GoalQuery(labels=labels + labels)))
    assert fields == list(labels[:8])


def test_numbers_that_cannot_be_sent_keep_their_meaning() -> None:
    page = PastPage(GoalQuery(since=-5, until=2**70), 10**9, (-1, b""))
    sent = past_from(past_fields(page))
    assert sent == PastPage(GoalQuery(since=0, until=2**63 - 1), 1000)
    assert past_from(past_fields(PastPage(after=(2**64, bytes(16))))).after == (
        2**63 - 1,
        bytes(16),
    )


def test_of_labels_those_are_told_and_taken_that_a_goal_may_have() -> None:
    most = {str(number): "" for number in range(8)}
    assert told_labels({}) is None
    assert labels_from(None) == {}
    assert told_labels({**most, "8": ""}) == labels_from({**most, "8": ""}) == most
