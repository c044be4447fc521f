"""ROS messages as values of actions, and within them, without ROS."""

from __future__ import annotations

import array
import datetime
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, EntryPoints
from typing import Annotated, Any, Literal, TypedDict, cast

import attrs
import msgspec
import pydantic
import pytest
from msgspec import Meta

from fibaction import Action
from fibaction.interfaces.ros_types import struct
from fibaction.ros_types import from_ros, to_ros
from fibaction.schema.payload import JsonCodec
from fibaction.types.action import Codec
from fibaction.types.ros_classes import INTERFACES, message_class, ros_type_of
from fibaction.types.ros_messages import plain_value
from fibaction.words.errors import ProtocolError
from tests.support.ros_classes import (
    Dock_Feedback,
    Dock_Goal,
    Dock_Result,
    Point,
    Scan,
    Stamped,
    Time,
    Vector3,
    ros_class,
)

numpy: Any = import_module("numpy")

OurPoint: Any = type(from_ros(Point()))
OurStamped: Any = type(from_ros(Stamped()))


class Place(msgspec.Struct):
    point: OurPoint
    name: str = ""
    path: list[OurPoint] = []
    marks: dict[str, OurPoint] = {}
    other: OurPoint | float | None = None
    pair: tuple[OurPoint, ...] = ()
    anything: Any = None


class Frozen(msgspec.Struct, frozen=True):
    point: OurPoint


@dataclass(frozen=True)
class Data:
    point: OurPoint


@attrs.frozen
class Attrs:
    point: OurPoint


class Typed(TypedDict):
    name: str
    point: Annotated[OurPoint, Meta(description="where")]


def there_and_back(value: Any, kind: Any = None) -> Any:
    codec = Codec(kind or type(value))
    return codec.decode(codec.encode(value))


def error_of(kind: Any, value: Any) -> str:
    with pytest.raises(TypeError) as caught:
        Codec(kind).encode(value)
    return str(caught.value)


# In place of a value


def test_a_message_stands_for_a_struct_that_is_made_from_its_type() -> None:
    message = Stamped(stamp=Time(sec=5), frame_id="map", point=Point(x=1.5))
    assert there_and_back(message, OurStamped) == from_ros(message)
    assert from_ros(message).point == OurPoint(x=1.5)


class XYZ(msgspec.Struct):
    x: float
    y: float
    z: float = 0.0


def test_a_message_stands_for_any_type_with_the_same_fields() -> None:
    assert there_and_back(Point(x=1.5), XYZ) == XYZ(1.5, 0.0)


class Moment(pydantic.BaseModel):
    stamp: datetime.datetime
    frame_id: str
    point: dict[str, float]


def test_a_message_is_converted_to_what_the_type_has_in_its_place() -> None:
    made = there_and_back(Stamped(stamp=Time(sec=5), point=Point(z=2.0)), Moment)
    assert made.stamp == datetime.datetime(1970, 1, 1, 0, 0, 5, tzinfo=datetime.UTC)
    assert made.point == {"x": 0.0, "y": 0.0, "z": 2.0}


def test_a_message_of_another_type_is_an_error_that_names_both() -> None:
    assert error_of(OurPoint, Vector3()) == (
        "Expected `like_msgs/msg/Point`, got `like_msgs/msg/Vector3`"
    )
    assert error_of(XYZ, Time()) == (
        "Expected `XYZ`, got `builtin_interfaces/msg/Time`: $.sec (int32): the action has no such"
        " field; $.nanosec (uint32): the action has no such field; $.x: the ROS type has no such"
        " field; $.y: the ROS type has no such field; $.z: the ROS type has no such field"
    )
    assert error_of(Literal["a"], Point()) == (
        "Expected `typing.Literal['a']`, got `like_msgs/msg/Point`: $: the ROS type has the struct"
        " like_msgs/Point, the action has a string"
    )


def test_a_type_name_says_which_messages_an_action_takes() -> None:
    action: Action[Any, Any, Any] = Action(
        "dock", goal=XYZ, feedback=float, result=str, type_name="like_msgs/action/Dock"
    )
    with pytest.raises(TypeError, match=r"^Expected `like_msgs/action/Dock_Goal`, got `like_msgs/"):
        action.goal.encode(Point())
    assert not action.goal.accepts(Point())


def test_a_value_that_is_not_a_message_and_is_not_known_is_the_error_of_before() -> None:
    assert error_of(Any, object()) == "Encoding objects of type object is unsupported"
    assert error_of(Place, Place(cast("Any", 1 + 2j))) == (
        "Encoding objects of type complex is unsupported"
    )
    with pytest.raises(ValueError, match="Expected `Moment`"):
        Codec(Moment).encode(cast("Any", object()))
    with pytest.raises(ValueError, match="half a character"):
        Codec(str).encode("\ud800")


# Within a value


@pytest.mark.parametrize("kind", [Place, Frozen, Data, Attrs])
def test_a_message_may_be_in_a_field_of_any_class(kind: Any) -> None:
    value = kind(Point(x=1.5))
    assert there_and_back(value).point == OurPoint(x=1.5)
    assert type(value.point) is Point, "the value itself is not changed"


def test_messages_may_be_in_lists_dicts_unions_and_anything() -> None:
    place = Place(
        OurPoint(),
        path=[Point(x=1.0), OurPoint(x=2.0)],
        marks={"a": Point(x=3.0)},
        other=Point(x=4.0),
        pair=(Point(x=5.0),),
        anything=[Vector3(x=6.0)],
    )
    made = there_and_back(place)
    assert made.path == [OurPoint(x=1.0), OurPoint(x=2.0)]
    assert (made.marks, made.other) == ({"a": OurPoint(x=3.0)}, OurPoint(x=4.0))
    assert (made.pair, made.anything) == ((OurPoint(x=5.0),), [{"x": 6.0, "y": 0.0, "z": 0.0}])
    made = there_and_back({"name": "a", "point": Point(x=7.0)}, Typed)
    assert made == {"name": "a", "point": OurPoint(x=7.0)}
    assert there_and_back([Point()], list[OurPoint]) == [OurPoint()]
    assert there_and_back([Point()], list) == [{"x": 0.0, "y": 0.0, "z": 0.0}]


def test_a_value_that_is_converted_to_a_message_may_have_some() -> None:
    value = OurStamped(frame_id="map", point=Point(x=1.5))
    assert to_ros(value) == Stamped(frame_id="map", point=Point(x=1.5))


def test_a_message_in_the_wrong_place_is_an_error_that_says_where() -> None:
    both = "Expected `like_msgs/msg/Point`, got `like_msgs/msg/Vector3`"
    assert error_of(Place, Place(Vector3())) == f"{both} - at `$.point`"
    assert error_of(Place, Place(OurPoint(), path=[OurPoint(), Vector3()])) == (
        f"{both} - at `$.path[1]`"
    )
    assert error_of(Place, Place(OurPoint(), marks={"a": Vector3()})) == f"{both} - at `$.marks.a`"
    assert error_of(Typed, {"name": "a", "point": Vector3()}) == f"{both} - at `$.point`"


def test_a_message_is_shown_as_plain_data() -> None:
    assert plain_value({"at": [Point(x=1.0)]}) == {"at": [{"x": 1.0, "y": 0.0, "z": 0.0}]}


def test_arrays_of_numbers_may_be_in_any_field() -> None:
    class Path(msgspec.Struct):
        xs: list[float]
        counts: list[int]
        data: bytes

    made = there_and_back(
        Path(cast("Any", numpy.arange(3.0)), cast("Any", array.array("i", [1])), numpy.uint8([1]))
    )
    assert (made.xs, made.counts, made.data) == ([0.0, 1.0, 2.0], [1], b"\1")


# As the type itself

DOCK: Action[Any, Any, Any] = Action(
    "dock",
    goal=Dock_Goal,
    feedback=Dock_Feedback,
    result=Dock_Result,
    type_name="like_msgs/action/Dock",
)


def test_a_class_of_ros_is_a_type_of_an_action() -> None:
    goal = Dock_Goal(target=Stamped(frame_id="map"))
    made = DOCK.goal.decode(DOCK.goal.encode(goal))
    assert (type(made), made) == (Dock_Goal, goal)
    with pytest.raises(TypeError, match=r"^Expected `like_msgs/action/Dock_Goal`, got `XYZ`$"):
        DOCK.goal.encode(XYZ(1, 2))
    with pytest.raises(ProtocolError, match=r"^feedback of action 'dock' is not of its type"):
        DOCK.feedback.decode(b"\x01")


def test_all_kinds_of_fields_come_back_as_ros_has_them() -> None:
    scan = Scan(
        ranges=array.array("f", [0.5] * 1000),
        covariance=numpy.arange(4.0),
        data=array.array("B", b"ab" * 500),
        points=[Point(x=1.0)],
        flags=[b"\1", b"\2"],
        flag=b"\7",
        names=["a", "b"],
        wide="w",
    )
    made = there_and_back(scan)
    assert made == scan
    kinds = (made.ranges.typecode, made.covariance.dtype, made.data.typecode)
    assert kinds == ("f", numpy.float64, "B")


def test_numbers_of_another_width_are_converted_and_not_read_as_they_lie_in_memory() -> None:
    made = there_and_back(Scan(ranges=numpy.full(1000, 0.5)))
    assert made.ranges.tolist() == [0.5] * 1000


def test_the_schema_of_a_class_of_ros_is_that_of_its_struct() -> None:
    assert JsonCodec(DOCK.info.goal).decode(DOCK.goal.encode(Dock_Goal())) == {
        "target": {
            "stamp": {"sec": 0, "nanosec": 0},
            "frame_id": "",
            "point": {"x": 0.0, "y": 0.0, "z": 0.0},
        }
    }


class Mission(msgspec.Struct):
    start: Point
    stops: list[Stamped] = []
    home: Point | None = None
    thing: object = None


def test_a_class_of_ros_is_the_type_of_a_field() -> None:
    mission = Mission(Point(x=1.5), [Stamped(frame_id="map")], Point(), 5)
    assert there_and_back(mission) == mission
    assert error_of(Mission, Mission(Vector3())) == (
        "Expected `like_msgs/msg/Point`, got `like_msgs/msg/Vector3` - at `$.start`"
    )
    with pytest.raises(ProtocolError) as caught:
        Codec(Mission).decode(msgspec.msgpack.encode({"start": {"x": "a"}}))
    assert str(caught.value) == "Expected `float`, got `str` in `.x` - at `$.start`"


class Patrol(msgspec.Struct):
    start: Point
    stops: list[Stamped] = []


def test_the_schema_of_a_type_with_classes_of_ros_has_their_fields() -> None:
    namesake = msgspec.defstruct("Point", [("text", str)])
    both: Any = msgspec.defstruct("Both", [("patrol", Patrol), ("point", namesake)])
    payload = JsonCodec(Codec(both).schema()).encode(
        {"patrol": {"start": {"x": 1.5}}, "point": {"text": "a"}}
    )
    made = Codec(both).decode(payload)
    assert (made.patrol.start.x, made.point.text) == (1.5, "a")
    assert Codec(Mission).schema() == {}, "`object` has no schema"


def test_a_class_that_ros_itself_cannot_handle_is_not_a_type() -> None:
    letter = ros_class("like_msgs/msg/Letter", {"letter": "wchar"})
    text = "like_msgs/Letter.letter is a wchar, which ROS itself cannot handle in Python"
    with pytest.raises(TypeError, match=f"^the goal of action 'a': {text}$"):
        Action("a", goal=letter, feedback=int, result=str)
    with pytest.raises(TypeError, match=f"{text}$"):
        Action("a", goal=msgspec.defstruct("Goal", [("at", letter)]), feedback=int, result=str)


# Which of the two, as an executor yields


def test_a_codec_accepts_its_values_and_the_messages_that_it_takes() -> None:
    assert DOCK.feedback.accepts(Dock_Feedback())
    assert not DOCK.feedback.accepts(Dock_Result())
    assert not DOCK.feedback.accepts(1)
    assert Codec(OurPoint).accepts(Point())
    assert not Codec(OurPoint).accepts(Vector3())


# Without a cost


def test_types_of_ros_are_named_as_ros_names_them() -> None:
    assert ros_type_of(Dock_Goal) == "like_msgs/action/Dock_Goal"
    assert ros_type_of(OurPoint) == "like_msgs/msg/Point"
    assert ros_type_of(XYZ) == ros_type_of(None) == ""
    made = struct("A", [], module="a", doc="", constants={})
    assert (ros_type_of(made), made.__module__) == ("", "a")


def test_without_a_package_that_knows_ros_a_message_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    message_class.cache_clear()
    entries = EntryPoints([EntryPoint(name="ros1", value="nowhere:make", group=INTERFACES)])
    select: Callable[..., Any] = entries.select
    monkeypatch.setattr("importlib.metadata.entry_points", select)
    assert error_of(dict, Point()).startswith(
        "Expected `dict`, got `like_msgs/msg/Point`: cannot make message types from"
        " 'like_msgs/msg/Point': install a package with an entry point 'ros2_messages'"
    )


def test_without_a_message_nothing_of_ros_or_numpy_is_imported() -> None:
    program = (
        "import sys\n"
        "from fibaction import Action\n"
        "action = Action('a', goal=float, feedback=int, result=str)\n"
        "action.goal.decode(action.goal.encode(1.5))\n"
        "names = 'numpy', 'fibaction.types.ros_messages', 'fibaction_transports', 'rclpy'\n"
        "print([name for name in names if name in sys.modules])\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (run.stdout, run.stderr) == ("[]\n", "")


def test_a_message_imports_no_transport() -> None:
    program = (
        "import sys\n"
        "from tests.support.ros_classes import Point\n"
        "from fibaction.ros_types import from_ros\n"
        "from_ros(Point())\n"
        "print([name for name in sys.modules if name.endswith('_transport') or 'rtps' in name])\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (run.stdout, run.stderr) == ("[]\n", "")
