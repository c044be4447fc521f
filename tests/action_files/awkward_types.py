"""The messages of `Awkward`.

Written by `fibaction gen` from Awkward.action.
Change that file, not this one.
"""

from builtins import bool as bool_, bytes as bytes_, float as float_, int as int_, list as list_, range as range_, str as str_
from typing import Annotated, ClassVar

from fibaction import Action
from fibaction.ros_types import Byte, Int32, Int8
from msgspec import Meta, Struct, field as field_


class Step(Struct, forbid_unknown_fields=True, kw_only=True):
    """`Step`."""

    size: Int32 = 1


class Awkward_Goal(Struct, forbid_unknown_fields=True, kw_only=True):
    """Names that mean something in Python, \"and comments with '''quotes'''\":
    \"\"\" and \\backslashes, and \"quotes\" at the \"end\"
    """

    STRUCT: ClassVar[int_] = 3
    PATH: ClassVar[str_] = "C:\\dir"
    # A comment on a constant that is so long that it takes more than a line of what is written of it, and more.
    #
    # And more.
    HUGE: ClassVar[float_] = 1e+300

    int: Annotated[Int32, Meta(description='It says "so" and \'so\', and \\ too. And it says so at such a length that it takes several lines in the source.\n\n  It has a second paragraph.')] = -1
    from_: Int32 = field_(default=7, name="from")
    class_: list_[Int32] = field_(default_factory=list_, name="class")
    import_: Annotated[list_[Int32], Meta(min_length=2, max_length=2)] = field_(default_factory=lambda: [1] * 2, name="import")
    str: str_ = "it's"
    bytes: Annotated[Byte, Meta(description="Two lines of a comment,\nthat fit into one line of source only alone.")] = 0
    bool: bool_ = True
    float: float_ = -0.5
    list: bytes_ = b''
    field: list_[Int8] = []
    annotated: Step = field_(default_factory=Step)
    range: Annotated[list_[Step], Meta(min_length=2, max_length=2)] = field_(default_factory=lambda: [Step() for _ in range_(2)])
    long_default: Annotated[list_[Int32], Meta(min_length=12, max_length=12)] = field_(default_factory=lambda: [100000, 200000, 300000, 400000, 500000, 600000, 700000, 800000, 900000, 1, 2, 3])
    long_text: Annotated[str_, Meta(max_length=1000)] = "A default that is longer than a line of source can be, as it goes on and on and on."
    a_name_of_such_a_length_that_a_line_is_not_enough_for_it_and_its_type: Annotated[list_[Annotated[str_, Meta(max_length=12)]], Meta(max_length=1000)] = []
    another_name_of_such_a_length_that_a_line_is_not_enough: Annotated[bytes_, Meta(min_length=16, max_length=16)] = b'\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00'


class Awkward_Result(Struct, forbid_unknown_fields=True, kw_only=True):
    """A comment that ends with a \\"""

    meta: Int32 = 0


class Awkward_Feedback(Struct, forbid_unknown_fields=True, kw_only=True):
    """The feedback of `Awkward`."""

    typing: Int32 = 0


AWKWARD = Action(
    "awkward",
    goal=Awkward_Goal,
    feedback=Awkward_Feedback,
    result=Awkward_Result,
)
