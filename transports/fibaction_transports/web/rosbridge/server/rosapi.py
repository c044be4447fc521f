"""The services that are served: those of rosapi about actions, and the cancel of an action.

Names of actions begin with `/` here, as in ROS, whatever the server calls them.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import msgspec

from fibaction.border.peer_text import REASON, excerpt
from fibaction.schema.payload import SchemaError
from fibaction.types.action import ActionInfo
from fibaction.wire.messages import LARGEST, CancelAnswered
from fibaction.words.errors import ProtocolError
from fibaction.words.goals import CancelAnswer, CancelCode, GoalID, GoalInfo
from fibaction.words.plain_data import is_list, is_map
from fibaction.words.statuses import GoalStatus
from fibaction_transports.web.rosbridge.operations import Arguments
from fibaction_transports.web.rosbridge.type_definitions import definitions

CANCEL_SUFFIX = "/_action/cancel_goal"
"""The end of the name of the service that cancels goals of an action."""
FEEDBACK_SUFFIX = "/_action/feedback"
"""The end of the name of the topic with the feedback of all goals of an action."""
STATUS_SUFFIX = "/_action/status"
"""The end of the name of the topic with the statuses of all goals of an action."""
SECOND = 10**9
"""Nanoseconds of a second."""

Values: TypeAlias = dict[str, Any]
Service: TypeAlias = Callable[[Sequence[ActionInfo], Arguments], Values]
"""A function of the actions that are served, and of the arguments of a call."""


class ServiceFailed(Exception):
    """An error for a call of a service that cannot be answered."""


def ros_name(action: str) -> str:
    """Return the name of an action as ROS writes it."""
    return action if action.startswith(("/", "~")) else f"/{action}"


def known_name(name: str, known: Iterable[str]) -> str:
    """Return the name under which an action is served; the given one if it is not served."""
    bare = name.removeprefix("/")
    return next((one for one in (name, bare, f"/{bare}") if one in known), name)


def service_of(name: str) -> Service | None:
    """Return the service of that name, which may begin with `/`; None if it is not of rosapi."""
    return _SERVICES.get(name.removeprefix("/"))


STATUS_TYPE = "action_msgs/msg/GoalStatusArray"
"""The type of the topic with the statuses of an action."""


def topic_types(info: ActionInfo) -> tuple[str, str]:
    """Return the types of the two topics of an action: feedback, which is empty if the type of the
    action has no name, and status.
    """
    return info.type_name and f"{info.type_name}_FeedbackMessage", STATUS_TYPE


def short_type(name: str) -> str:
    """Return the name of a type in its short form, such as `action_msgs/GoalStatusArray`."""
    return name.replace("/action/", "/").replace("/msg/", "/")


def _topic_types(infos: Sequence[ActionInfo]) -> dict[str, str]:
    """Return the types of all topics, by the names of the topics."""
    return {
        f"{ros_name(info.name)}{suffix}": kind
        for info in infos
        for suffix, kind in zip((FEEDBACK_SUFFIX, STATUS_SUFFIX), topic_types(info), strict=True)
    }


def _details(part: str) -> Service:
    """Return the service that describes the goals, the results or the feedback of a type."""

    def service(infos: Sequence[ActionInfo], args: Arguments) -> Values:
        name = _text(args, "type")
        names = {info.type_name: info for info in reversed(infos) if info.type_name}
        names |= {long.replace("/action/", "/"): info for long, info in names.items()}
        info = names.get(name)
        if info is None:
            raise ServiceFailed(f"the action type {excerpt(name)!r} is not served here")
        package, _, kind = info.type_name.replace("/action/", "/").partition("/")
        try:
            found = definitions(getattr(info, part), f"{package}/{kind}_{part.capitalize()}")
        except SchemaError as exc:
            raise ServiceFailed(f"the schema of the {part} {exc}") from exc
        return {"typedefs": msgspec.to_builtins(found)}

    return service


def _action_type(infos: Sequence[ActionInfo], args: Arguments) -> Values:
    types = {info.name: info.type_name for info in infos}
    return {"type": types.get(known_name(_text(args, "action"), types), "")}


def _services(infos: Sequence[ActionInfo], _: Arguments) -> Values:
    cancels = [f"{ros_name(info.name)}{CANCEL_SUFFIX}" for info in infos]
    return {"services": [*cancels, *(f"/{name}" for name in _SERVICES)]}


def _topics(infos: Sequence[ActionInfo], _: Arguments) -> Values:
    types = _topic_types(infos)
    return {"topics": list(types), "types": list(types.values())}


def _topics_for_type(infos: Sequence[ActionInfo], args: Arguments) -> Values:
    wanted = _text(args, "type")
    return {"topics": [topic for topic, kind in _topic_types(infos).items() if kind == wanted]}


_SERVICES: Mapping[str, Service] = {
    "rosapi/action_servers": lambda infos, _: {
        "action_servers": [ros_name(info.name) for info in infos]
    },
    "rosapi/action_type": _action_type,
    "rosapi/action_goal_details": _details("goal"),
    "rosapi/action_result_details": _details("result"),
    "rosapi/action_feedback_details": _details("feedback"),
    "rosapi/interfaces": lambda infos, _: {
        "interfaces": sorted({info.type_name for info in infos if info.type_name})
    },
    "rosapi/services": _services,
    "rosapi/topics": _topics,
    "rosapi/topic_type": lambda infos, args: {
        "type": _topic_types(infos).get(f"/{_text(args, 'topic').removeprefix('/')}", "")
    },
    "rosapi/topics_for_type": _topics_for_type,
    # Without ROS there is no name of a release.
    "rosapi/get_ros_version": lambda _infos, _args: {
        "version": 2,
        "distro": os.environ.get("ROS_DISTRO", ""),
    },
}


def _text(args: Arguments, name: str) -> str:
    """Return the only argument of a call."""
    value = args[0] if isinstance(args, list) and args else _member(args, name)
    if not isinstance(value, str):
        raise ServiceFailed(f"the argument {name} must be text")
    return value


def _member(value: object, name: str) -> Any:
    return value.get(name) if is_map(value) else None


# action_msgs/srv/CancelGoal


def cancel_request(args: Arguments) -> tuple[bytes | None, int | None]:
    """Return the goal and the stamp of a cancel; None for any goal, and for any time.

    Raises:
        ServiceFailed: An argument is wrong.
    """
    info = args[0] if isinstance(args, list) and args else _member(args, "goal_info")
    uuid = _member(_member(info, "goal_id"), "uuid")
    stamp = _member(info, "stamp")
    times = [_member(stamp, name) or 0 for name in ("sec", "nanosec")]
    if not all(isinstance(time, int) and time >= 0 for time in times):
        raise ServiceFailed("goal_info.stamp must have whole numbers: sec and nanosec")
    goal_id = bytes(16) if uuid is None else _uuid(uuid)
    nanoseconds = min(times[0] * SECOND + times[1], LARGEST)
    return (goal_id if any(goal_id) else None), nanoseconds or None


def _uuid(value: object) -> bytes:
    """Return 16 bytes, which are numbers or base64 text in JSON."""
    found = b""
    try:
        if isinstance(value, str):
            found = base64.b64decode(value, validate=True)
        elif is_list(value):
            found = bytes(value)
    except (TypeError, ValueError):
        pass
    if len(found) != 16:
        raise ServiceFailed("goal_info.goal_id.uuid must have 16 bytes: numbers, or base64 text")
    return found


def cancel_response(answer: CancelAnswered) -> Values:
    """Return the answer to a cancel; the reason of a rejected one is beside what ROS has."""
    goals = [
        {
            "goal_id": {"uuid": base64.b64encode(goal_id).decode()},
            "stamp": {"sec": stamp // SECOND, "nanosec": stamp % SECOND},
        }
        for goal_id, stamp, _ in answer.goals
    ]
    values: Values = {"return_code": answer.return_code, "goals_canceling": goals}
    return values | ({"reason": answer.reason} if answer.reason else {})


# The same, as a client has it


def cancel_arguments(stamp: int | None) -> Values:
    """Return the arguments of the cancel of all goals up to a time; of all goals if it is None."""
    sec, nanosec = divmod(stamp or 0, SECOND)
    time = {"sec": min(sec, 2**31 - 1), "nanosec": nanosec}
    return {"goal_info": {"goal_id": {"uuid": [0] * 16}, "stamp": time}}


def cancel_answer(values: object) -> CancelAnswer:
    """Return the answer in the values of a server.

    Raises:
        ProtocolError: They are not an answer to a cancel.
    """
    try:
        code = CancelCode(_member(values, "return_code"))
        goals = tuple(map(_canceling, _member(values, "goals_canceling")))
    except (ServiceFailed, TypeError, ValueError) as exc:
        raise ProtocolError(f"invalid answer to a cancel: {excerpt(str(exc))}") from exc
    reason = _member(values, "reason")
    return CancelAnswer(code, goals, excerpt(reason, REASON) if isinstance(reason, str) else "")


def _canceling(info: object) -> GoalInfo:
    uuid = _uuid(_member(_member(info, "goal_id"), "uuid"))
    stamp = _member(info, "stamp")
    nanoseconds = int(_member(stamp, "sec")) * SECOND + int(_member(stamp, "nanosec"))
    return GoalInfo(GoalID(uuid), nanoseconds, GoalStatus.CANCELING)
