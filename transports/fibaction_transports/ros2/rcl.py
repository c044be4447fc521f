"""What is used of rclpy, all of it, under one roof.

rclpy has no types that a checker could see without ROS, and some of it is its inner surface (raw
handles, `Waitable`): whoever adapts this package to another rclpy looks here first.
"""

from __future__ import annotations

import re
import warnings
from importlib import import_module
from typing import Any

rclpy: Any = import_module("rclpy")
Context: Any = import_module("rclpy.context").Context
Duration: Any = import_module("rclpy.duration").Duration
Future: Any = import_module("rclpy.task").Future
ReentrantCallbackGroup: Any = import_module("rclpy.callback_groups").ReentrantCallbackGroup
SignalHandlerOptions: Any = import_module("rclpy.signals").SignalHandlerOptions
check_for_type_support: Any = import_module("rclpy.type_support").check_for_type_support
deserialize: Any = import_module("rclpy.serialization").deserialize_message
qos: Any = import_module("rclpy.qos")
validate_namespace: Any = import_module("rclpy.validate_namespace").validate_namespace
validate_node_name: Any = import_module("rclpy.validate_node_name").validate_node_name
waitable: Any = import_module("rclpy.waitable")

_executors: Any = import_module("rclpy.executors")
SingleThreadedExecutor: Any = _executors.SingleThreadedExecutor
ExternalShutdownException: Any = _executors.ExternalShutdownException

raw: Any = import_module("rclpy.impl.implementation_singleton").rclpy_implementation
"""Handles without the classes around them: `Service`, `Client`, `Publisher`, `Subscription`."""
InvalidHandle: type[Exception] = raw.InvalidHandle
LIVELINESS_CHANGED: Any = raw.rcl_subscription_event_type_t.RCL_SUBSCRIPTION_LIVELINESS_CHANGED

GoalInfoMessage: Any = import_module("action_msgs.msg").GoalInfo

_numpy: Any = import_module("numpy")

# Only what rclpy says of calls in this module, and so of nobody else's services.
warnings.filterwarnings(
    "error", r"failed to send response \(timeout\)", RuntimeWarning, re.escape(__name__)
)


def has_answered(service: Any, response: Any, header: Any) -> bool:
    """Send the answer of a raw service; False if the middleware has yet to find the way to who
    asked.

    A client and a server find each other's ends one by one, so a request may arrive before its
    answer can. Fast DDS waits 0.1 s for that, and stops all of Python meanwhile; then rclpy only
    warns, and nobody sends the answer again.
    """
    try:
        service.service_send_response(response, header)
    except (RuntimeWarning, SystemError) as exc:
        # rclpy does not look whether its warning became an error, and CPython notices that.
        if not isinstance(exc.__cause__ or exc, RuntimeWarning):
            raise
        return False
    return True


def uuid_of(goal_id: bytes) -> Any:
    """A goal ID as the field `uuid` has it."""
    return _numpy.frombuffer(goal_id, dtype=_numpy.uint8)
