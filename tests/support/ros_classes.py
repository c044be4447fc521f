"""Classes like those that ROS generates for its messages, for tests without ROS.

They have the protocol of `rosidl_generator_py`: `__slots__`, a metaclass with the constants,
`get_fields_and_field_types`, keyword arguments, and the same types of values in their fields.
"""

from __future__ import annotations

import array
import sys
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from types import ModuleType, SimpleNamespace
from typing import Any

numpy: Any = import_module("numpy")


CODES = {"double": "d", "float": "f", "int32": "i", "uint8": "B", "int8": "b"}
SINGLES: dict[str, Any] = {
    "boolean": False,
    "octet": b"\0",
    "double": 0.0,
    "float": 0.0,
    "int32": 0,
    "uint32": 0,
    "uint8": 0,
    "string": "",
    "wstring": "",
}


def ros_class(
    type_name: str, fields: dict[str, str], *, is_found: bool = True, **constants: Any
) -> Any:
    """Make the class of a ROS type, such as `geometry_msgs/msg/Point`.

    With `is_found`, it can be imported as one of ROS, unless ROS itself is there with its package.
    """
    package, folder, name = type_name.split("/")

    def init(self: Any, **given: Any) -> None:
        for field, kind in fields.items():
            setattr(self, field, given.pop(field) if field in given else initial(kind))
        assert not given, given

    def equal(self: Any, other: object) -> bool:
        return type(self) is type(other) and all(
            numpy.array_equal(getattr(self, field), getattr(other, field)) for field in fields
        )

    members = {
        "__module__": f"{package}.{folder}._{name.lower()}",
        "__slots__": [f"_{field}" for field in fields] + ["_check_fields"],
        "__init__": init,
        "__eq__": equal,
        "__hash__": None,
        "get_fields_and_field_types": classmethod(lambda cls: dict(fields)),
        **{field: member(f"_{field}") for field in fields},
    }
    properties = {key: property(partial(_constant, one)) for key, one in constants.items()}
    made = type(f"Metaclass_{name}", (type,), properties)(name, (), members)
    if not is_found or find_spec(package) is not None:
        return made
    part = name.partition("_")
    module = sys.modules.setdefault(f"{package}.{folder}", ModuleType(f"{package}.{folder}"))
    if part[1]:  # the goal of an action is `Dock.Goal`
        action = vars(module).setdefault(part[0], SimpleNamespace())
        setattr(action, part[2], made)
    else:
        setattr(module, name, made)
    return made


def _constant(value: Any, _: type) -> Any:
    return value


def member(slot: str) -> Any:
    """Return the property of a field."""

    def put(self: Any, value: Any) -> None:
        setattr(self, slot, value)

    return property(attrgetter(slot), put)


def initial(kind: str) -> Any:
    """Return what a field has in a new message."""
    if kind.startswith("sequence<"):
        element = kind.removeprefix("sequence<").removesuffix(">").partition(",")[0]
        return array.array(CODES[element]) if element in CODES else []
    if kind.endswith("]"):
        element, _, size = kind.removesuffix("]").partition("[")
        if element in CODES:
            return numpy.zeros(int(size), CODES[element])
        return [initial(element) for _ in range(int(size))]
    if "/" in kind:
        package, _, name = kind.partition("/")
        return getattr(import_module(f"{package}.msg"), name)()
    return SINGLES[kind.partition("<")[0]]


# The package has another name than ROS's own, which may be installed beside these tests.
Time = ros_class("builtin_interfaces/msg/Time", {"sec": "int32", "nanosec": "uint32"})
Point = ros_class("like_msgs/msg/Point", dict.fromkeys("xyz", "double"), ORIGIN=0, KIND=b"\7")
Vector3 = ros_class("like_msgs/msg/Vector3", dict.fromkeys("xyz", "double"))
Stamped = ros_class(
    "like_msgs/msg/Stamped",
    {"stamp": "builtin_interfaces/Time", "frame_id": "string", "point": "like_msgs/Point"},
)
Scan = ros_class(
    "like_msgs/msg/Scan",
    {
        "ranges": "sequence<float>",
        "covariance": "double[4]",
        "data": "sequence<uint8>",
        "points": "sequence<like_msgs/Point, 3>",
        "flags": "sequence<octet>",
        "flag": "octet",
        "names": "string<5>[2]",
        "wide": "wstring",
    },
)
Dock_Goal = ros_class("like_msgs/action/Dock_Goal", {"target": "like_msgs/Stamped"})
Dock_Feedback = ros_class("like_msgs/action/Dock_Feedback", {"distance": "double"})
Dock_Result = ros_class("like_msgs/action/Dock_Result", {"distance": "double"})
