"""Types of Cyclone DDS for messages of ROS, made as IDL names them."""

from __future__ import annotations

from typing import Any

from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, int8, int32, int64, sequence, uint8, uint32


def message(name: str, **fields: Any) -> Any:
    """Return the type of a message, such as `std_msgs/msg/String`."""
    package, folder, short = name.split("/")
    return make_idl_struct(short, f"{package}::{folder}::dds_::{short}_", fields)


HEADER = {"client": array[uint8, 8], "number": int64}
"""What rmw_cyclonedds has ahead of the message of a request, and of the reply to it."""

Text = message("std_msgs/msg/String", data=str)
Uuid = message("unique_identifier_msgs/msg/UUID", uuid=array[uint8, 16])
Time = message("builtin_interfaces/msg/Time", sec=int32, nanosec=uint32)
GoalInfo = message("action_msgs/msg/GoalInfo", goal_id=Uuid, stamp=Time)
GoalStatus = message("action_msgs/msg/GoalStatus", goal_info=GoalInfo, status=int8)
GoalStatusArray = message("action_msgs/msg/GoalStatusArray", status_list=sequence[GoalStatus])
CancelRequest = message("action_msgs/srv/CancelGoal_Request", **HEADER, goal_info=GoalInfo)
CancelResponse = message(
    "action_msgs/srv/CancelGoal_Response",
    **HEADER,
    return_code=int8,
    goals_canceling=sequence[GoalInfo],
)

FIBONACCI = "arduinobot_msgs/action/Fibonacci"
Goal = message(f"{FIBONACCI}_Goal", order=int32)
Result = message(f"{FIBONACCI}_Result", sequence=sequence[int32])
Feedback = message(f"{FIBONACCI}_Feedback", partial_sequence=sequence[int32])
SendGoalRequest = message(f"{FIBONACCI}_SendGoal_Request", **HEADER, goal_id=Uuid, goal=Goal)
SendGoalResponse = message(f"{FIBONACCI}_SendGoal_Response", **HEADER, accepted=bool, stamp=Time)
GetResultRequest = message(f"{FIBONACCI}_GetResult_Request", **HEADER, goal_id=Uuid)
GetResultResponse = message(f"{FIBONACCI}_GetResult_Response", **HEADER, status=int8, result=Result)
FeedbackMessage = message(f"{FIBONACCI}_FeedbackMessage", goal_id=Uuid, feedback=Feedback)
