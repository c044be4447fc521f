"""The messages of ROS's common packages, from the library rosbags, for machines without ROS.

rosbags has the definitions of about 160 messages, of `std_msgs`, `geometry_msgs`, `nav_msgs`,
`sensor_msgs` and others, for each release of ROS. It leaves out the defaults of fields, which only
`geometry_msgs/Quaternion` has among them. It is imported where a message has no file.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any, Final

INSTALL: Final = "pip install 'fibaction[ros-types]'"
"""The command that installs the library."""
_RELEASE: Final = "LATEST"
_ROS_2 = 2
_DEFAULTS = {
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
}


@cache
def _store() -> Any:
    try:
        types = import_module("rosbags.typesys")
    except ImportError:
        return None
    return types.get_typestore(types.Stores[_RELEASE])


def common_message(package: str, name: str) -> str | None:
    """Return the text that defines a message; None if the library is missing, or has no such
    message.
    """
    store, type_name = _store(), f"{package}/msg/{name}"
    if store is None or type_name not in store.fielddefs:
        return None
    if type_name in _DEFAULTS:
        return _DEFAULTS[type_name]
    whole: str = store.generate_msgdef(type_name, ros_version=_ROS_2)[0]
    return whole.partition("=" * 80)[0]  # the definitions of nested messages follow


def advice(package: str) -> str:
    """Return what an error adds about a message of a package that is not found."""
    if not package or _store() is not None:
        return ""
    return f"; to get the messages of ROS's common packages: {INSTALL}"
