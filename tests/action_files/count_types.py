"""The messages of `Count`.

Written by `fibaction gen` from Count.action.
Change that file, not this one.
"""

from fibaction import Action
from fibaction.ros_types import Int32
from msgspec import Struct, field


class Step(Struct, forbid_unknown_fields=True, kw_only=True):
    """`Step`."""

    size: Int32 = 1


class Count_Goal(Struct, forbid_unknown_fields=True, kw_only=True):
    """Counts what matches \\d+, as C:\\temp does not."""

    order: Int32 = 0
    step: Step = field(default_factory=Step)


class Count_Result(Struct, forbid_unknown_fields=True, kw_only=True):
    """The result of `Count`."""

    sequence: list[Int32] = []


class Gripper(Struct, forbid_unknown_fields=True, kw_only=True):
    """`other_msgs/Gripper`."""

    name: str = ""


class Count_Feedback(Struct, forbid_unknown_fields=True, kw_only=True):
    """The feedback of `Count`."""

    used: Gripper = field(default_factory=Gripper)


COUNT = Action(
    "count",
    goal=Count_Goal,
    feedback=Count_Feedback,
    result=Count_Result,
)
