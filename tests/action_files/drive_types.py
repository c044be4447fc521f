"""The types `geometry_msgs/msg/Twist`, `std_srvs/srv/SetBool`.

Written by `fibaction gen`.
"""

from typing import ClassVar

from fibaction.action_files import define_types
from fibaction_transports.ros2 import Service
from msgspec import Struct, field


class Vector3(Struct, forbid_unknown_fields=True, kw_only=True):
    """`geometry_msgs/Vector3`."""

    __ros_type__: ClassVar[str] = "geometry_msgs/msg/Vector3"

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Twist(Struct, forbid_unknown_fields=True, kw_only=True):
    """`geometry_msgs/Twist`."""

    __ros_type__: ClassVar[str] = "geometry_msgs/msg/Twist"

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


class SetBool_Request(Struct, forbid_unknown_fields=True, kw_only=True):
    """The request of `SetBool`."""

    __ros_type__: ClassVar[str] = "std_srvs/srv/SetBool_Request"

    data: bool = False


class SetBool_Response(Struct, forbid_unknown_fields=True, kw_only=True):
    """The response of `SetBool`."""

    __ros_type__: ClassVar[str] = "std_srvs/srv/SetBool_Response"

    success: bool = False
    message: str = ""


SET_BOOL = Service(
    "std_srvs/srv/SetBool",
    SetBool_Request,
    SetBool_Response,
)

define_types(
    {
        "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
        "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
        "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
    }
)
