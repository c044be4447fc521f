"""Everything that this package uses of rclpy.

A type checker cannot see rclpy without ROS, and some of this is not public in rclpy (raw handles,
`Waitable`). To adapt this package to another version of rclpy, begin here.
"""

from __future__ import annotations

import re
import warnings
from importlib import import_module
from typing import Any

rclpy: Any = import_module("rclpy")
Context: Any = import_module("rclpy.context").Context
JumpThreshold: Any = import_module("rclpy.clock").JumpThreshold
Duration: Any = import_module("rclpy.duration").Duration
GuardCondition: Any = import_module("rclpy.guard_condition").GuardCondition
ParameterService: Any = import_module("rclpy.parameter_service").ParameterService
ReentrantCallbackGroup: Any = import_module("rclpy.callback_groups").ReentrantCallbackGroup
SingleThreadedExecutor: Any = import_module("rclpy.executors").SingleThreadedExecutor
check_for_type_support: Any = import_module("rclpy.type_support").check_for_type_support
deserialize: Any = import_module("rclpy.serialization").deserialize_message
rclpy_qos: Any = import_module("rclpy.qos")
validate_namespace: Any = import_module("rclpy.validate_namespace").validate_namespace
validate_node_name: Any = import_module("rclpy.validate_node_name").validate_node_name
waitable: Any = import_module("rclpy.waitable")

_signals: Any = import_module("rclpy.signals")
SignalHandlerGuardCondition: Any = _signals.SignalHandlerGuardCondition
SignalHandlerOptions: Any = _signals.SignalHandlerOptions

raw: Any = import_module("rclpy.impl.implementation_singleton").rclpy_implementation
"""Raw handles, without rclpy's classes: `Service`, `Client`, `Publisher`, `Subscription`."""
InvalidHandle: type[Exception] = raw.InvalidHandle
UnsupportedEventType: type[Exception] = raw.UnsupportedEventTypeError
IntrospectionState: Any = raw.service_introspection.ServiceIntrospectionState
middleware: Any = rclpy.get_rmw_implementation_identifier
LIVELINESS_CHANGED: Any = raw.rcl_subscription_event_type_t.RCL_SUBSCRIPTION_LIVELINESS_CHANGED

GoalInfoMessage: Any = import_module("action_msgs.msg").GoalInfo
ros_messages: Any = import_module("rcl_interfaces.msg")
ros_parameters: Any = import_module("rclpy.parameter")
ros_exceptions: Any = import_module("rclpy.exceptions")
ParameterMessage: Any = import_module("rcl_interfaces.msg").Parameter

_numpy: Any = import_module("numpy")

# An error only for calls in this module: services of other code keep their warning.
warnings.filterwarnings(
    "error", r"failed to send response \(timeout\)", RuntimeWarning, re.escape(__name__)
)


def has_answered(service: Any, response: Any, header: Any) -> bool:
    """Send the answer of a raw service, and return False if it cannot reach the client yet.

    A client and a server discover each other's ends one by one, so a request may arrive before its
    answer can be sent. Fast DDS waits 0.1 s for that, and stops all of Python meanwhile. Then rclpy
    only warns, and does not send the answer again.
    """
    try:
        service.service_send_response(response, header)
    except (RuntimeWarning, SystemError) as exc:
        # rclpy ignores that its warning became an error, and CPython raises SystemError for that.
        if not isinstance(exc.__cause__ or exc, RuntimeWarning):
            raise
        return False
    return True


def uuid_of(goal_id: bytes) -> Any:
    """Return a goal ID as the value of the field `uuid`."""
    return _numpy.frombuffer(goal_id, dtype=_numpy.uint8)
