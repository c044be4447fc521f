"""Messages whose fields hold plain values of Python, as without ROS's generated classes."""

from __future__ import annotations

import array
import importlib
import sys
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from fibaction.interfaces.ros_types import struct
from fibaction.types import arrays
from fibaction.types.arrays import LARGE_ARRAY
from fibaction.words.errors import ProtocolError
from fibaction_transports.ros2.convert import fields
from fibaction_transports.ros2.convert.conversion import RosCodec
from fibaction_transports.ros2.convert.fields import SINGLES, Kind, array_kind, text_kind
from fibaction_transports.ros2.convert.message_types import MessageKind, MessagePart
from fibaction_transports.ros2.convert.schemas import UserSchema
from fibaction_transports.ros2.node.ros_node import RosNode

KINDS: dict[str, Kind] = {
    "octet": SINGLES["byte"],
    "octets": array_kind(SINGLES["byte"], None, None),
    "fixed": array_kind(SINGLES["int32"], 3, None),
    "floats": array_kind(SINGLES["float32"], None, None),
    "uint8s": array_kind(SINGLES["uint8"], None, None),
    "words": array_kind(text_kind(wide=False, bound=None), None, 2),
    "from": SINGLES["int64"],
}
DEFAULTS: dict[str, Any] = {
    "octet": 0,
    "octets": b"",
    "fixed": array.array("i", [0, 0, 0]),
    "floats": array.array("f"),
    "uint8s": b"",
    "words": [],
    "from_": 0,
}

encode = msgspec.msgpack.encode
decode = msgspec.msgpack.decode


class Plain:
    """A message with ROS's defaults."""

    def __init__(self) -> None:
        self.__dict__.update(DEFAULTS)


class User(msgspec.Struct, rename={"from_": "from"}):
    """What a user has: bytes for a byte, and lists."""

    octet: bytes
    octets: list[int]
    uint8s: bytes
    fixed: list[int] = msgspec.field(default_factory=lambda: [1, 2, 3])
    floats: list[float] = []
    words: list[str] = []
    from_: int = 0


def codec_for(user: Any = None) -> RosCodec:
    plain = [(name, kind.default, None) for name, kind in KINDS.items()]
    default = struct("Plain", plain, module="made_up.msg", doc="Plain.", constants={})
    kind = MessageKind("made_up/Plain", Plain, KINDS, default)
    problems: list[str] = []
    schema = {} if user is None else msgspec.json.schema(user)
    part = kind.bind(UserSchema(schema), "message", problems)
    assert problems == []
    assert isinstance(part, MessagePart)
    return RosCodec(part)


@pytest.fixture(params=["with numpy", "without numpy"])
def large(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """A number of elements from which on numpy is used, if it is there."""
    if request.param == "without numpy":
        for module in (arrays, fields):
            monkeypatch.setattr(module, "numpy", lambda: None)
    return LARGE_ARRAY


@pytest.fixture
def without_numpy() -> Iterator[None]:
    numpy = sys.modules["numpy"]
    sys.modules["numpy"] = None  # type: ignore[assignment]  # so that it cannot be found
    yield
    sys.modules["numpy"] = numpy
    importlib.reload(arrays)


def test_bytes_are_integers_and_bytes_and_users_may_have_either() -> None:
    for octet, octets in ((7, [1, 2]), (b"\7", b"\1\2"), (7, [1, b"\2"])):
        message = codec_for().to_ros(encode({"octet": octet, "octets": octets}))
        assert (message.octet, message.octets) == (7, b"\1\2")
    assert decode(codec_for().from_ros(message))["octets"] == b"\1\2"

    codec = codec_for(User)
    message = codec.to_ros(encode(User(b"\7", [1, 2], b"\3")))
    assert (message.octet, message.octets) == (7, b"\1\2")
    assert decode(codec.from_ros(message), type=User) == User(b"\7", [1, 2], b"\3")


def test_lists_of_octets_as_bytes_are_told_as_such() -> None:
    class Odd(User, rename={"from_": "from"}):
        octets: list[bytes]  # type: ignore[assignment]  # as another user has it

    codec = codec_for(Odd)
    message = codec.to_ros(encode(Odd(b"\7", [b"\1", b"\2"], b"")))
    assert message.octets == b"\1\2"
    assert decode(codec.from_ros(message))["octets"] == [b"\1", b"\2"]


def test_numbers_are_arrays_of_a_fixed_number_or_of_any(large: int) -> None:
    many = [0.5] * large
    message = codec_for().to_ros(encode({"fixed": [1, 2, 3], "floats": many, "uint8s": b"\5"}))
    assert message.fixed == array.array("i", [1, 2, 3])
    assert message.floats == array.array("f", many)
    found = decode(codec_for().from_ros(message))
    assert (found["fixed"], found["floats"], found["uint8s"]) == ([1, 2, 3], many, b"\5")


@pytest.mark.parametrize("count", [3, LARGE_ARRAY])
def test_octets_of_numbers_are_read_from_bytes_as_well(count: int, large: int) -> None:
    class Numbered(User, rename={"from_": "from"}):
        uint8s: list[int]  # type: ignore[assignment]  # as another user has it

    message = Plain()
    message.__dict__["uint8s"] = bytes([200] * count)
    assert decode(codec_for(Numbered).from_ros(message))["uint8s"] == [200] * count


def test_numbers_that_do_not_fit_are_errors(large: int) -> None:
    for payload, text in (
        ({"fixed": [1, 2]}, r"\$.fixed"),
        ({"floats": [1e39] * large}, r"32 bits.*\$.floats\[0\]"),
        ({"floats": [0.5] * large + ["a"]}, r"\$.floats\[256\]"),
    ):
        with pytest.raises(ProtocolError, match=text):
            codec_for().to_ros(encode(payload))


def test_a_field_whose_name_is_a_keyword_has_another_attribute() -> None:
    for codec in (codec_for(), codec_for(User)):
        message = codec.to_ros(encode({"octet": b"\0", "octets": [], "uint8s": b"", "from": 5}))
        assert message.from_ == 5
        assert decode(codec.from_ros(message))["from"] == 5
    with pytest.raises(ProtocolError, match=r"\$.from`"):
        codec_for().to_ros(encode({"from": "x"}))


def test_a_text_may_have_a_nul_and_a_sequence_is_bounded() -> None:
    assert codec_for().to_ros(encode({"words": ["a\0b"]})).words == ["a\0b"]
    with pytest.raises(ProtocolError, match="words"):
        codec_for().to_ros(encode({"words": ["a"] * 3}))


@pytest.mark.usefixtures("without_numpy")
def test_the_conversion_can_be_imported_without_numpy() -> None:
    assert importlib.reload(arrays).numpy() is None


def test_ends_are_counted_in_the_graph_if_there_is_no_quicker_way() -> None:
    class Graph:
        def publishers(self, topic: str) -> list[str]:
            return [topic] * 2

        subscriptions = publishers

    node: Any = Graph()
    assert RosNode.count_publishers(node, "status") == 2
    assert RosNode.count_subscriptions(node, "feedback") == 2
