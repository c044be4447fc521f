"""The messages of `robot_msgs/action/PickUp`.

Written by `fibaction gen` from PickUp.action.
Change that file, not this one.
"""

from typing import Annotated, ClassVar

from fibaction import Action
from fibaction.action_files import define_action
from fibaction.ros_types import Int32, Int8, UInt16, UInt32, UInt64, UInt8
from msgspec import Meta, Struct, field


class Pad(Struct, forbid_unknown_fields=True, kw_only=True):
    """`robot_msgs/Pad`."""

    wear: UInt8 = 0
    pressure: list[float] = []


class robot_msgs_Gripper(Struct, forbid_unknown_fields=True, kw_only=True):
    """What it holds things with."""

    FINGERS: ClassVar[int] = 2

    width: float = 0.1
    pads: Annotated[list[Pad], Meta(min_length=2, max_length=2)] = field(default_factory=lambda: [Pad() for _ in range(2)])


class other_msgs_Gripper(Struct, forbid_unknown_fields=True, kw_only=True):
    """`other_msgs/Gripper`."""

    name: str = ""


class Time(Struct, forbid_unknown_fields=True, kw_only=True):
    """A point in time, counted from 1970 (UTC), or in a simulation from its start."""

    sec: Annotated[Int32, Meta(description="Seconds, valid over all int32 values.")] = 0
    nanosec: Annotated[UInt32, Meta(description="Nanoseconds to be added, in the range [0, 1e9).")] = 0


class Duration(Struct, forbid_unknown_fields=True, kw_only=True):
    """A span of time."""

    sec: Annotated[Int32, Meta(description="Seconds, valid over all int32 values.")] = 0
    nanosec: Annotated[UInt32, Meta(description="Nanoseconds to be added, in the range [0, 1e9).")] = 0


class PickUp_Goal(Struct, forbid_unknown_fields=True, kw_only=True):
    """Pick something up, and bring it somewhere."""

    CAREFUL: ClassVar[int] = 1
    # In a hurry, things fall.
    HASTY: ClassVar[int] = 2
    GREETING: ClassVar[str] = "hello"
    HALF: ClassVar[float] = 0.5
    ALWAYS: ClassVar[bool] = True

    manner: Annotated[Int8, Meta(description="How to do it: CAREFUL or HASTY.")] = 1
    thing: Annotated[str, Meta(max_length=20)] = 'a "box"'
    gripper: Annotated[robot_msgs_Gripper, Meta(description="what to hold it with")] = field(default_factory=robot_msgs_Gripper)
    spare: Annotated[list[other_msgs_Gripper], Meta(min_length=2, max_length=2)] = field(default_factory=lambda: [other_msgs_Gripper() for _ in range(2)])
    where: Annotated[list[float], Meta(min_length=3, max_length=3)] = field(default_factory=lambda: [0.5, -0.5, 0.0])
    speeds: Annotated[list[float], Meta(max_length=4)] = field(default_factory=lambda: [1.5])
    ports: Annotated[list[UInt16], Meta(min_length=2, max_length=2)] = field(default_factory=lambda: [0] * 2)
    names: list[str] = field(default_factory=lambda: ["one", "two, and three"])
    address: Annotated[bytes, Meta(min_length=4, max_length=4)] = b'\x00\x00\x00\x00'
    token: bytes = b'\x01\x02\xff'
    labels: Annotated[list[Annotated[str, Meta(max_length=5)]], Meta(max_length=3)] = []
    start: Time = field(default_factory=Time)
    pauses: list[Duration] = []
    large: UInt64 = 18446744073709551615


class PickUp_Result(Struct, forbid_unknown_fields=True, kw_only=True):
    """The result of `PickUp`."""


class PickUp_Feedback(Struct, forbid_unknown_fields=True, kw_only=True):
    """Between 0 and 1."""

    progress: Annotated[float, Meta(description="It may go back\n  when something falls.")] = 0.0
    lost: bool = False


PICK_UP = Action(
    "pick_up",
    goal=PickUp_Goal,
    feedback=PickUp_Feedback,
    result=PickUp_Result,
    type_name="robot_msgs/action/PickUp",
)

define_action(
    "robot_msgs/action/PickUp",
    {
        "robot_msgs/action/PickUp": 'int8 CAREFUL = 1\nint8 HASTY = 2\nstring GREETING = "hello"\nfloat64 HALF = 0.5\nbool ALWAYS = true\nint8 manner 1\nstring<=20 thing "a \\"box\\""\nGripper gripper\nother_msgs/Gripper[2] spare\nfloat64[3] where [0.5, -0.5, 0.0]\nfloat32[<=4] speeds [1.5]\nuint16[2] ports\nstring[] names ["one", "two, and three"]\nuint8[4] address\nbyte[] token [1, 2, 255]\nwstring<=5[<=3] labels\nbuiltin_interfaces/Time start\nbuiltin_interfaces/Duration[] pauses\nuint64 large 18446744073709551615\n---\n---\nfloat32 progress\nbool lost\n',
        "robot_msgs/msg/Pad": "uint8 wear\nfloat64[] pressure\n",
        "robot_msgs/msg/Gripper": "int32 FINGERS = 2\nfloat64 width 0.1\nPad[2] pads\n",
        "other_msgs/msg/Gripper": "string name\n",
        "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
        "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec\n",
    },
)
