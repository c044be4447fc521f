"""The paths of the REST interface, and the methods of each.

Names of actions have slashes, so a path is read from its right end: `/actions/arm/pick/goals` are
the goals of `arm/pick`. The address of an action whose name ends with `/goals` is that of a list.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum, auto

from fibaction._http_rules import Refused
from fibaction._text import excerpt
from fibaction.goals import NO_GOAL, GoalID


class Resource(Enum):
    """A kind of thing that has an address."""

    DESCRIPTION = auto()
    ACTIONS = auto()
    ACTION = auto()
    GOALS = auto()
    GOAL = auto()
    EVENTS = auto()


METHODS = {
    Resource.DESCRIPTION: ("GET",),
    Resource.ACTIONS: ("GET",),
    Resource.ACTION: ("GET",),
    Resource.GOALS: ("GET", "POST", "DELETE"),
    Resource.GOAL: ("GET", "PUT", "DELETE"),
    Resource.EVENTS: ("GET",),
}
"""The methods of each resource."""


@dataclass(frozen=True)
class Route:
    """The resource that a request is about."""

    resource: Resource
    action: str = ""
    goal_id: GoalID = NO_GOAL
    """The ID of the goal; `NO_GOAL` if the resource is not one goal."""


_GOAL = re.compile(r"/actions/(?P<action>.+)/goals/(?P<goal>[^/]+)(?P<events>/events)?")
_GOALS = re.compile(r"/actions/(?P<action>.+)/goals")
_ACTION = re.compile(r"/actions/(?P<action>.+)")


def route_of(method: str, path: str) -> Route:
    """Return what a request is about, by the path below the root of the application.

    Raises:
        Refused: Nothing is there, or it does not have this method.
    """
    route = _route_of(path)
    methods = METHODS[route.resource]
    if method not in methods:
        allowed = ", ".join(methods)
        raise Refused(
            405,
            f"{excerpt(path)} has the methods {allowed}, and not {excerpt(method)}",
            ("Allow", allowed),
        )
    return route


def _route_of(path: str) -> Route:
    if path == "/openapi.json":
        return Route(Resource.DESCRIPTION)
    if path == "/actions":
        return Route(Resource.ACTIONS)
    if found := _GOAL.fullmatch(path):
        resource = Resource.EVENTS if found["events"] else Resource.GOAL
        return Route(resource, found["action"], _goal_id_of(found["goal"]))
    if found := _GOALS.fullmatch(path):
        return Route(Resource.GOALS, found["action"])
    if found := _ACTION.fullmatch(path):
        return Route(Resource.ACTION, found["action"])
    raise Refused(404, f"there is nothing at {excerpt(path)}: see /openapi.json")


def _goal_id_of(text: str) -> GoalID:
    try:
        goal_id = GoalID.parse(text)
    except ValueError:
        raise Refused(
            400, f"a goal ID has 32 hexadecimal digits, unlike {excerpt(text)!r}"
        ) from None
    if goal_id == NO_GOAL:
        raise Refused(400, "the goal ID of zeros means all goals: it has no address")
    return goal_id
