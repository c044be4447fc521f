from __future__ import annotations

import dataclasses
import datetime
import decimal
import enum
import math
import pathlib
import re
import typing
import uuid
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import EntryPoint, EntryPoints
from typing import (
    Annotated,
    Any,
    Generic,
    Literal,
    NamedTuple,
    NewType,
    TypedDict,
    TypeVar,
    cast,
)

import attrs
import msgspec
import pytest
from hypothesis import example, given, strategies

from fibaction.types.action import NO_VALUE, Action, ActionInfo, Codec
from fibaction.types.ros_classes import INTERFACES
from fibaction.words.errors import ProtocolError, TransportError
from tests.support.fibonacci import FIBONACCI, Feedback, Goal, Result

T = TypeVar("T")
Metres = NewType("Metres", float)


def shown(value: object) -> str:
    """As `repr`, but the same in each process: tests are spread over several."""
    if isinstance(value, set | frozenset):
        value = sorted(value, key=repr)
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


class Pose(msgspec.Struct):
    x: int
    y: int


class Place(Pose):
    name: str


class Path(msgspec.Struct):
    poses: list[Pose]
    frames: dict[str, Pose] = {}


class Box(msgspec.Struct, Generic[T]):
    content: T


@dataclasses.dataclass
class DataPose:
    x: int


@attrs.define
class AttrsPose:
    x: int


class TypedPose(TypedDict):
    x: int


class NamedPose(NamedTuple):
    x: int


class Colour(enum.Enum):
    RED = "red"


class Level(enum.IntEnum):
    LOW = 1


class Stranger:
    """A class of which msgspec knows nothing."""


# Names


@pytest.mark.parametrize(
    "name",
    ["fibonacci", "arm/pick_up", "/abs/name", "~/private", "_x", "a1/b2", "Upper", "a/_b"],
)
def test_a_name_follows_the_rule_of_ros(name: str) -> None:
    action = Action(name, goal=int, feedback=int, result=str)
    assert action.name == name
    assert repr(action) == f"<Action {name!r}>"


@pytest.mark.parametrize(
    "name",
    ["", "1a", "a/1", "a//b", "a/", "/", "//a", "~", "~a", "a/~/b", "a b", "a-b", "é", "a\n"],
)
def test_another_name_is_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="an action's name is like `arm/pick_up`") as caught:
        Action(name, goal=int, feedback=int, result=str)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize(
    "type_name", ["", "example_interfaces/action/Fibonacci", "a/action/B", "a1_b/action/B2c"]
)
def test_a_type_name_is_that_of_a_ros_action_or_empty(type_name: str) -> None:
    action = Action("a", goal=int, feedback=int, result=str, type_name=type_name)
    assert action.type_name == type_name


@pytest.mark.parametrize(
    "type_name",
    [
        "Fibonacci",
        "a/Fibonacci",
        "a/msg/Fibonacci",
        "a/action/fibonacci",
        "A/action/Fibonacci",
        "1a/action/Fibonacci",
        "a/action/1Fibonacci",
        "a/action/Fibonacci_2",
        "a/action/",
        "a/action/Fibonacci/b",
        "a/action/Fibonacci\n",
        "é/action/Fibonacci",
    ],
)
def test_another_type_name_is_rejected(type_name: str) -> None:
    with pytest.raises(ValueError, match="a type name is like") as caught:
        Action("a", goal=int, feedback=int, result=str, type_name=type_name)
    assert repr(type_name) in str(caught.value)


@pytest.mark.parametrize("wrong", [None, 0, b"", b"a/action/B", ()])
def test_a_name_that_is_no_text_is_rejected(wrong: Any) -> None:
    with pytest.raises(TypeError) as caught:
        Action(wrong, goal=int, feedback=int, result=str)
    assert str(caught.value) == f"an action's name is like `arm/pick_up`, not {wrong!r}"
    with pytest.raises(TypeError) as caught:
        Action("a", goal=int, feedback=int, result=str, type_name=wrong)
    assert str(caught.value) == (
        f"a type name is like `example_interfaces/action/Fibonacci`, not {wrong!r}"
    )


# Message types


NOON = datetime.datetime(2024, 2, 29, 12, 0, tzinfo=datetime.UTC)

VALUES: list[tuple[Any, Any]] = [
    (Pose, Pose(1, 2)),
    (Path, Path([Pose(1, 2)], {"map": Pose(0, 0)})),
    (Box, Box([1])),
    (Box[int], Box(1)),
    (DataPose, DataPose(1)),
    (AttrsPose, AttrsPose(1)),
    (TypedPose, {"x": 1}),
    (NamedPose, NamedPose(1)),
    (Colour, Colour.RED),
    (Level, Level.LOW),
    (Literal["fast", 1, None], "fast"),
    (Literal["fast", 1, None], 1),
    (Literal["fast", 1, None], None),
    (int | str, 1),
    (int | str, "one"),
    (Pose | None, Pose(1, 2)),
    (Pose | None, None),
    (Annotated[int, msgspec.Meta(ge=1)], 1),
    (Annotated[int, msgspec.Meta(description="metres")], 1),
    (Metres, 1.5),
    (None, None),
    (bool, True),
    (int, -(2**63)),
    (int, 2**64 - 1),
    (float, 1.5),
    (float, math.inf),
    (str, "é"),
    (bytes, b"\xff"),
    (bytearray, bytearray(b"\xff")),
    (memoryview, memoryview(b"\xff")),
    (list, [1, "one", None]),
    (list[int], [1]),
    (Sequence[int], [1]),
    (tuple[int, str], (1, "one")),
    (tuple[int, ...], (1, 2)),
    (set, {1, "one"}),
    (set[int], {1}),
    (frozenset[int], frozenset({1})),
    (frozenset[Any], frozenset({1, "one"})),
    (dict, {"x": [1]}),
    (dict[int, Pose], {1: Pose(1, 2)}),
    (Mapping[str, int], {"x": 1}),
    (datetime.datetime, NOON),
    (datetime.date, NOON.date()),
    (datetime.time, NOON.time()),
    (datetime.timedelta, datetime.timedelta(seconds=1.5)),
    (uuid.UUID, uuid.UUID(int=1)),
    (decimal.Decimal, decimal.Decimal("1.50")),
    (msgspec.Raw, msgspec.Raw(b"\x01")),
    (msgspec.msgpack.Ext, msgspec.msgpack.Ext(5, b"\xff")),
    (Any, {"x": [1]}),
    (object, [1]),
]


@pytest.mark.parametrize(("message_type", "value"), VALUES, ids=shown)
def test_a_value_becomes_bytes_and_comes_back(message_type: Any, value: Any) -> None:
    codec: Codec[Any] = Codec(message_type)
    assert codec.type is message_type
    payload = codec.encode(value)
    assert type(payload) is bytes
    back = codec.decode(payload)
    assert back == value
    assert type(back) is type(value)
    assert codec.holds(back)
    assert codec.holds(Stranger()) is (message_type in (Any, object))


@pytest.mark.parametrize(
    ("message_type", "value"), [(float, 1), (Pose, Place(1, 2, "home")), (int, True)]
)
def test_a_value_that_type_checkers_let_pass_is_held(message_type: Any, value: Any) -> None:
    assert Codec(message_type).holds(value)


@pytest.mark.parametrize("message_type", [list[int] | tuple[int, ...], Pose | DataPose], ids=shown)
def test_a_type_that_cannot_be_decoded_is_rejected(message_type: Any) -> None:
    with pytest.raises(TypeError):
        Codec(message_type)
    with pytest.raises(TypeError):
        Action("a", goal=message_type, feedback=int, result=str)


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (Stranger(), TypeError),
        ([Stranger()], TypeError),
        (2**64, OverflowError),
        (-(2**63) - 1, OverflowError),
    ],
    ids=shown,
)
def test_a_value_that_msgpack_cannot_express_is_rejected(
    value: object, error: type[Exception]
) -> None:
    with pytest.raises(error):
        Codec(object).encode(value)


# Telling feedback and result apart


@pytest.mark.parametrize(
    ("feedback", "result"),
    [
        (Pose, Pose),
        (Pose, Place),
        (Place, Pose),
        (Box[int], Box[str]),
        (bool, int),
        (float, int),
        (Level, int),
        (Literal["on"], str),
        (Literal["on"], Literal["off"]),
        (Colour, Colour),
        (Pose | None, DataPose | None),
        (Pose | None, None),
        (int | str, str),
        (list[int], list[str]),
        (NamedPose, tuple[int, ...]),
        (TypedPose, dict[str, int]),
        (datetime.datetime, datetime.date),
        (Any, Pose),
        (Pose, object),
        (Annotated[int, msgspec.Meta(description="metres")], int),
        (Metres, float),
    ],
    ids=shown,
)
def test_an_action_knows_that_feedback_and_result_cannot_be_told_apart(
    feedback: Any, result: Any
) -> None:
    assert Action("a", goal=int, feedback=feedback, result=result).is_ambiguous


@pytest.mark.parametrize(
    ("feedback", "result"),
    [
        (Feedback, Result),
        (Pose, DataPose),
        (TypedPose, str),
        (Box[int], Pose),
        (int, str),
        (int | Pose, str | None),
        (list[int], tuple[int, ...]),
        (Literal["on"], Literal[1]),
        (bytes, bytearray),
        (Colour, str),
    ],
    ids=shown,
)
def test_the_class_tells_feedback_from_result(feedback: Any, result: Any) -> None:
    action = Action("a", goal=int, feedback=feedback, result=result)
    assert not set(action.feedback.classes) & set(action.result.classes)
    assert not action.is_ambiguous


# Strict decoding


@pytest.mark.parametrize(
    ("message_type", "plain", "text"),
    [
        (Goal, {"order": "ten"}, "Expected `int`, got `str` - at `$.order`"),
        (Goal, {"order": 1.5}, "Expected `int`, got `float` - at `$.order`"),
        (Goal, {"order": True}, "Expected `int`, got `bool` - at `$.order`"),
        (Goal, {}, "Object missing required field `order`"),
        (Goal, [1], "Expected `object`, got `array`"),
        (
            Path,
            {"poses": [{"x": 1, "y": 2}, {"x": 1, "y": "2"}]},
            "Expected `int`, got `str` - at `$.poses[1].y`",
        ),
        (
            Path,
            {"poses": [], "frames": {"map": {"x": 1}}},
            "Object missing required field `y` - at `$.frames[...]`",
        ),
        (Colour, "blue", "Invalid enum value 'blue'"),
        (Literal["on"], "off", "Invalid enum value 'off'"),
        (Annotated[int, msgspec.Meta(ge=1)], 0, "Expected `int` >= 1"),
        (uuid.UUID, "no", "Invalid UUID"),
    ],
    ids=shown,
)
def test_a_value_of_another_type_is_rejected_and_the_field_is_named(
    message_type: Any, plain: Any, text: str
) -> None:
    with pytest.raises(ProtocolError) as caught:
        Codec(message_type).decode(msgspec.msgpack.encode(plain))
    assert str(caught.value) == text
    assert caught.value.__cause__ is caught.value.__context__ is None  # may hold the payload


def test_what_a_server_sent_that_is_not_of_its_type_is_told_with_the_action() -> None:
    sent = msgspec.msgpack.encode({"partial_sequence": "near", "sequence": "near"})
    for codec, what, field in (
        (FIBONACCI.feedback, "feedback", "partial_sequence"),
        (FIBONACCI.result, "the result", "sequence"),
    ):
        with pytest.raises(ProtocolError) as caught:
            codec.decode(sent)
        assert str(caught.value) == (
            f"{what} of action 'fibonacci' is not of its type, as its server sent it:"
            f" Expected `array`, got `str` - at `$.{field}`"
        )
    with pytest.raises(ProtocolError, match=r"^Object missing required field `order`$"):
        FIBONACCI.goal.decode(sent)  # which a client has sent: it is told why it is rejected


def test_a_field_that_the_type_does_not_have_is_skipped() -> None:
    payload = msgspec.msgpack.encode({"order": 1, "added_later": [2]})
    assert Codec(Goal).decode(payload) == Goal(1)


ANYTHING: Codec[Any] = Codec(typing.cast("type[Any]", Any))


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",  # the one byte that msgpack does not use
        b"\x01\x01",  # two values
        b"\x92\x01",  # half a list
        b"\xdd\xff\xff\xff\xff",  # a list of four thousand million
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x81\x80\x01",  # a map as the key of a map
        b"\xd7\xff" + b"\xff" * 8,  # a point of time with too many nanoseconds
    ],
    ids=bytes.hex,
)
def test_malformed_bytes_are_a_protocol_error(payload: bytes) -> None:
    with pytest.raises(ProtocolError):
        ANYTHING.decode(payload)


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\x01"], ids=["lists", "maps"])
def test_nesting_without_end_is_a_protocol_error(opening: bytes) -> None:
    with pytest.raises(ProtocolError, match="recursion"):
        ANYTHING.decode(opening * 100_000)


@pytest.mark.parametrize("message_type", [set, frozenset[Any]])
def test_a_set_of_what_cannot_be_in_a_set_is_a_protocol_error(message_type: Any) -> None:
    with pytest.raises(ProtocolError):
        Codec(message_type).decode(b"\x91\x80")


CODECS: list[Codec[Any]] = list(
    {repr(message_type): Codec(message_type) for message_type, _ in VALUES}.values()
)
PAYLOADS = [codec.encode(value) for codec, value in ((Codec(t), value) for t, value in VALUES)]

plain = strategies.recursive(
    strategies.none()
    | strategies.booleans()
    | strategies.integers(-(2**63), 2**64 - 1)
    | strategies.floats()
    | strategies.text(max_size=5)
    | strategies.binary(max_size=20),
    lambda inner: (
        strategies.lists(inner, max_size=4)
        | strategies.dictionaries(strategies.sampled_from(["x", "y", "poses"]), inner)
    ),
    max_leaves=6,
)


@strategies.composite
def damaged(draw: strategies.DrawFn) -> bytes:
    """A message with one stretch of it replaced."""
    payload = draw(strategies.sampled_from(PAYLOADS))
    start = draw(strategies.integers(0, len(payload)))
    end = draw(strategies.integers(start, len(payload)))
    return payload[:start] + draw(strategies.binary(max_size=4)) + payload[end:]


class Unfinished(msgspec.Struct):
    """A type whose own check has a fault."""

    name: str

    def __post_init__(self) -> None:
        raise KeyError(self.name)


@dataclasses.dataclass
class UnfinishedToo:
    name: str

    def __post_init__(self) -> None:
        raise KeyError(self.name)


@pytest.mark.parametrize("message_type", [Unfinished, UnfinishedToo])
def test_whatever_a_type_itself_raises_is_an_error_of_what_was_sent(message_type: Any) -> None:
    with pytest.raises(ProtocolError, match=r"^KeyError: 'arm'$"):
        Codec(message_type).decode(msgspec.msgpack.encode({"name": "arm"}))


@example(b"\x81\x80\x01")
@given(strategies.binary(max_size=40) | damaged() | plain.map(msgspec.msgpack.encode))
def test_any_bytes_give_a_value_or_a_protocol_error(payload: bytes) -> None:
    for codec in CODECS:
        try:
            value = codec.decode(payload)
        except ProtocolError as exc:
            refusal = str(exc)
            assert refusal
        else:
            assert codec.holds(value)


# Descriptions


def test_an_action_describes_itself_with_the_schemas_of_its_types() -> None:
    assert FIBONACCI.info == ActionInfo(
        "fibonacci",
        "arduinobot_msgs/action/Fibonacci",
        goal=msgspec.json.schema(Goal),
        feedback=msgspec.json.schema(Feedback),
        result=msgspec.json.schema(Result),
    )
    assert FIBONACCI.info.goal["$defs"]["Goal"]["properties"] == {"order": {"type": "integer"}}


def test_a_type_without_a_schema_allows_anything() -> None:
    extension = msgspec.msgpack.Ext
    assert Codec(extension).schema() == {}
    assert Action("a", goal=extension, feedback=int, result=str).info.goal == {}


class Recursive(msgspec.Struct):
    parts: list[Recursive]


@pytest.mark.parametrize("message_type", [Stranger, list[Stranger], dict[str, Stranger | None]])
def test_a_class_that_cannot_be_encoded_is_rejected_when_the_action_is_made(
    message_type: Any,
) -> None:
    with pytest.raises(TypeError) as caught:
        Action("a", goal=message_type, feedback=int, result=str)
    assert str(caught.value) == (
        "the goal of action 'a': Stranger cannot be encoded: use a msgspec.Struct, a dataclass, an"
        " attrs class, a pydantic model, a TypedDict or a builtin"
    )
    Action("a", goal=Recursive, feedback=int, result=str)


@dataclasses.dataclass
class Unfounded:
    there: Nowhere  # type: ignore[name-defined]  # noqa: F821  # the action tells so


@pytest.mark.parametrize(
    ("message_type", "text"),
    [
        (DataPose(1), "DataPose(x=1) is a value, and not a type"),
        ("Goal", "'Goal' is a value, and not a type"),
        (
            Unfounded,
            "Unfounded has a field of a type that is not defined: name 'Nowhere' is not defined",
        ),
        (
            list[int] | tuple[int, ...],
            (
                "a message does not tell the types of list[int] | tuple[int, ...] apart: use one of"
                " them"
            ),
        ),
        (typing.NoReturn, "Type 'typing.NoReturn' is not supported"),
    ],
    ids=shown,
)
def test_a_type_that_cannot_be_is_told_with_the_message_that_it_is_of(
    message_type: Any, text: str
) -> None:
    for kind, message in (
        ("goal", "the goal"),
        ("feedback", "feedback"),
        ("result", "the result"),
        ("checkpoint", "the checkpoint"),
    ):
        types: Any = {"goal": int, "feedback": int, "result": str, kind: message_type}
        with pytest.raises(TypeError) as caught:
            Action("a", **types)
        assert str(caught.value) == f"{message} of action 'a': {text}"


@pytest.mark.parametrize(
    ("value", "path"),
    [
        (2**64, "$"),
        ([{"a": 1.5}, {"a": "\ud800"}], "$[1].a"),
        ({"\ud800": 1}, "$"),
        (Path([Pose(1, 2)], {"a": Pose(3, -(2**64))}), "$.frames.a.y"),
        (([2**64], [1]), "$[0][0]"),
    ],
    ids=shown,
)
def test_a_number_or_a_text_that_cannot_be_sent_is_told_with_its_place(
    value: Any, path: str
) -> None:
    with pytest.raises((OverflowError, ValueError), match=re.escape(f" - at `{path}`")):
        Codec(object).encode(value)


def test_a_number_that_cannot_be_sent_is_told_without_its_place_if_that_is_not_found() -> None:
    itself: list[Any] = [2**64]
    itself.append(itself)
    for value in (itself, [2**64, object()]):
        with pytest.raises(OverflowError, match=r"send it as text$"):
            Codec(object).encode(value)


def test_a_type_is_told_as_it_is_written() -> None:
    kinds: list[Any] = [None, int, Pose, list[int], int | None, type(None)]

    texts = [Codec(kind).type_text for kind in kinds]

    assert texts == ["None", "int", "Pose", "list[int]", "int | None", "None"]


def test_an_untyped_action_takes_and_gives_plain_data() -> None:
    action = Action.untyped(FIBONACCI.info)
    assert FIBONACCI.goal.decode(action.goal.encode({"order": 3})) == Goal(3)
    assert action.feedback.decode(FIBONACCI.feedback.encode(Feedback([0, 1]))) == {
        "partial_sequence": [0, 1]
    }
    assert action.result.decode(FIBONACCI.result.encode(Result([0]))) == {"sequence": [0]}


def test_what_is_no_plain_data_is_told_with_the_action_too() -> None:
    action = Action.untyped(FIBONACCI.info)
    for codec, what in ((action.feedback, "feedback"), (action.result, "the result")):
        with pytest.raises(ProtocolError) as caught:
            codec.decode(b"\x91")
        assert str(caught.value) == (
            f"{what} of action 'fibonacci' is not of its type, as its server sent it:"
            f" Input data was truncated"
        )
    with pytest.raises(ProtocolError, match=r"^Input data was truncated$"):
        action.goal.decode(b"\x91")


def test_an_untyped_action_cannot_tell_a_result_from_feedback() -> None:
    action = Action.untyped(FIBONACCI.info)
    assert action.feedback.classes == action.result.classes == (object,)


# Types from ROS


def make_three(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    """What a package that makes types might have."""
    assert type_name == "arduinobot_msgs/action/Fibonacci"
    return Goal, Feedback, Result


def refuse(type_name: str) -> tuple[type[Any], type[Any], type[Any]]:
    raise TransportError("the ROS package 'arduinobot_msgs' is not installed here")


Install = Callable[..., None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    """Makes this the one that makes types from those of ROS; None removes all."""

    def install(value: str | None, name: str = "ros2") -> None:
        entries = [
            EntryPoint(name="ros1", value="nowhere:make", group=INTERFACES),
            EntryPoint(name="ros2", value="nowhere:make", group="fibaction.transports"),
        ]
        if value is not None:
            entries.append(EntryPoint(name=name, value=value, group=INTERFACES))
        monkeypatch.setattr("importlib.metadata.entry_points", EntryPoints(entries).select)

    return install


def from_ros(name: str = "fibonacci") -> Action[Any, Any, Any]:
    return Action.from_ros("arduinobot_msgs/action/Fibonacci", name=name)


def test_an_action_from_ros_has_the_types_that_were_made(install: Install) -> None:
    install(f"{__name__}:make_three")
    action = from_ros("arm/fibonacci")
    assert (action.goal.type, action.feedback.type, action.result.type) == (Goal, Feedback, Result)
    assert (action.name, action.type_name) == ("arm/fibonacci", "arduinobot_msgs/action/Fibonacci")


def test_classes_of_ros_are_asked_for_by_name(install: Install) -> None:
    install(f"{__name__}:make_three", "ros2_classes")
    action = Action.from_ros("arduinobot_msgs/action/Fibonacci", name="fibonacci", classes="ros")
    assert action.goal.type is Goal
    with pytest.raises(ValueError, match=r"^classes must be 'structs' or 'ros', not 'rclpy'$"):
        Action.from_ros("a_msgs/action/A", name="a", classes=cast("Any", "rclpy"))


def test_what_is_said_of_a_type_that_cannot_be_had_is_not_changed(install: Install) -> None:
    install(f"{__name__}:refuse")
    with pytest.raises(TransportError, match=r"^the ROS package 'arduinobot_msgs' is not inst"):
        from_ros()


def test_without_a_package_that_makes_types_there_are_none(install: Install) -> None:
    install(None)
    with pytest.raises(TransportError) as caught:
        from_ros()
    assert str(caught.value) == (
        "cannot make message types from 'arduinobot_msgs/action/Fibonacci': install a package with"
        " an entry point 'ros2' in the group 'fibaction.interfaces', such as fibaction itself"
    )


@pytest.mark.parametrize(
    ("source", "text"),
    [
        (
            "raise ImportError('for another Python')",
            (
                "cannot make message types from 'arduinobot_msgs/action/Fibonacci':"
                " interfaces_0:make cannot be imported: for another Python"
            ),
        ),
        (
            "from fibaction import TransportError\nraise TransportError('source your ROS')",
            "source your ROS",
        ),
    ],
    ids=["something", "what it needs"],
)
def test_a_package_that_cannot_be_imported_says_why(
    install: Install,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: pathlib.Path,
    source: str,
    text: str,
) -> None:
    (tmp_path / "interfaces_0.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    install("interfaces_0:make")
    with pytest.raises(TransportError) as caught:
        from_ros()
    assert str(caught.value) == text


def test_an_action_has_the_payload_of_a_goal_that_is_not_given() -> None:
    nothing = Action("nothing", goal=type(None), feedback=int, result=str)
    easy = Action("easy", goal=dict[str, int], feedback=int, result=str)
    assert nothing.default_goal() == b"\xc0"
    assert Action.untyped(nothing.info).default_goal() == b"\x80"
    assert Action.untyped(ActionInfo("old", goal={"type": "null"})).default_goal() == b"\xc0"
    assert easy.default_goal() == Action.untyped(easy.info).default_goal() == b"\x80"
    with pytest.raises(TypeError, match="the action 'drive' needs a goal, and none was given"):
        Action("drive", goal=int, feedback=int, result=str).default_goal()


class Home(msgspec.Struct):
    """Drive home.

    Slowly.
    """


@dataclasses.dataclass
class Picky:
    speed: float = 0.0

    def __post_init__(self) -> None:
        raise ValueError("it is picky")


def test_no_goal_and_a_goal_without_fields_are_the_same() -> None:
    nothing = Action("home", goal=None, feedback=int, result=str)
    home = Action("home", goal=Home, feedback=int, result=str)
    picky = Action("home", goal=Picky, feedback=int, result=str)
    for payload in (b"\xc0", b"\x80"):
        assert nothing.goal.decode(payload) is None
        assert home.goal.decode(payload) == Home()
        with pytest.raises(ProtocolError):
            picky.goal.decode(payload)
    assert nothing.info.goal == {"type": "object", "properties": {}, "additionalProperties": False}
    with pytest.raises(ProtocolError, match="feedback of action 'home' is not of its type"):
        Action("home", goal=int, feedback=None, result=str).feedback.decode(b"\x80")


def test_an_action_has_the_description_of_its_goal_without_an_indent() -> None:
    described = "Drive home.\n\nSlowly."
    info = Action("home", goal=Home, feedback=int, result=str).info
    assert info.description == described
    root: dict[str, Any] = {"description": "At once.", **info.goal}
    assert ActionInfo("home", goal=root).description == "At once."
    for goal in ({"description": 1}, {"$ref": "#/$defs/A", "$defs": []}, {"$ref": 1}):
        assert ActionInfo("home", goal=goal).description == ""


def test_a_goal_is_given_as_one_argument_or_not_at_all() -> None:
    plain = Action("plain", goal=int, feedback=int, result=int)
    assert plain.goal_from((3,), {}) == 3
    assert plain.goal_from((), {}) is NO_VALUE
    for args, fields in (((1, 2), {}), ((), {"meters": 3})):
        with pytest.raises(TypeError, match="is one value, and is given as one argument: "):
            plain.goal_from(args, fields)


def test_the_description_of_an_action_counts_more_than_that_of_its_goal() -> None:
    plain = Action("plain", goal=int, feedback=int, result=int)
    plain.description = "Count."
    assert plain.info.description == "Count."
