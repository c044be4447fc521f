"""ROS 2 by rclpy, which nothing else in fibaction imports."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from fibaction.border.peer_text import excerpt
from fibaction.words.errors import TransportError

_SPEC = find_spec("rclpy")
if _SPEC is None:
    raise TransportError(
        "ros2:// needs rclpy, which this Python does not find: source the setup.bash of a ROS 2"
        " installation, or, to try it out on Linux, use the wheels of a third party: pip install"
        " 'ros-rclpy[fastrtps]'"
    )

# After that check
try:
    from fibaction_transports.ros2.on_rclpy.rclpy_adapter import RclpyAdapter
except ImportError as exc:
    version, reason = sys.version_info, str(exc).partition("\n")[0]
    raise TransportError(
        f"this Python {version[0]}.{version[1]} cannot import the rclpy in {_SPEC.origin}"
        f" ({excerpt(reason)}); is PYTHONPATH left over from a ROS of another Python?"
    ) from exc

__all__ = ["RclpyAdapter"]
