"""The paths of the REST interface, and the methods of each.

Names of actions have slashes, so a path is read from its right end: `/actions/arm/pick/goals` are
the goals of `arm/pick`. An action may itself be called `arm/goals`, so of the ways to read a path
the first counts whose action is served. If `arm` is served, too, `/actions/arm/goals` are the goals
of `arm`.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum, auto

from fibaction.border.http_access import Refused
from fibaction.border.peer_text import excerpt
from fibaction.words.goals import NO_GOAL, GoalID


class Resource(Enum):
    """A kind of thing that has an address."""

    DESCRIPTION = auto()
    ACTIONS = auto()
    ACTION = auto()
    STATISTICS = auto()
    INTAKE = auto()
    GOALS = auto()
    GOAL = auto()
    EVENTS = auto()
    RERUN = auto()
    LOG = auto()
    SEARCH = auto()


METHODS = {
    Resource.DESCRIPTION: ("GET",),
    Resource.ACTIONS: ("GET",),
    Resource.ACTION: ("GET",),
    Resource.STATISTICS: ("GET",),
    Resource.INTAKE: ("GET", "PUT"),
    Resource.GOALS: ("GET", "POST", "DELETE"),
    Resource.GOAL: ("GET", "PUT", "DELETE"),
    Resource.EVENTS: ("GET",),
    Resource.RERUN: ("POST",),
    Resource.LOG: ("GET",),
    Resource.SEARCH: ("GET",),
}
"""The methods of each resource; HEAD is GET without the body of the answer."""


FILTERS = ("status", "client", "label", "since", "until", "parent")
"""The parameters that choose goals."""

PARAMETERS = {
    (Resource.STATISTICS, "GET"): ("since",),
    (Resource.GOALS, "GET"): (*FILTERS, "past", "limit", "after"),
    (Resource.GOALS, "POST"): ("wait", "label"),
    (Resource.GOALS, "DELETE"): (*FILTERS, "before"),
    (Resource.GOAL, "GET"): ("wait",),
    (Resource.GOAL, "PUT"): ("wait", "label"),
    (Resource.EVENTS, "GET"): ("after", "times"),
    (Resource.SEARCH, "GET"): (*FILTERS, "action", "search", "sort", "limit", "offset"),
}
"""The parameters of each resource and method; the others have none."""


@dataclass(frozen=True)
class Route:
    """The resource that a request is about."""

    resource: Resource
    action: str = ""
    goal_id: GoalID = NO_GOAL
    """The ID of the goal; `NO_GOAL` if the resource is not one goal."""


_PATHS = {
    re.compile(r"/actions/(?P<action>.+)/goals/(?P<goal>[^/]+)/events"): Resource.EVENTS,
    re.compile(r"/actions/(?P<action>.+)/goals/(?P<goal>[^/]+)/rerun"): Resource.RERUN,
    re.compile(r"/actions/(?P<action>.+)/goals/(?P<goal>[^/]+)/log"): Resource.LOG,
    re.compile(r"/actions/(?P<action>.+)/goals/(?P<goal>[^/]+)"): Resource.GOAL,
    re.compile(r"/actions/(?P<action>.+)/goals"): Resource.GOALS,
    re.compile(r"/actions/(?P<action>.+)/stats"): Resource.STATISTICS,
    re.compile(r"/actions/(?P<action>.+)/intake"): Resource.INTAKE,
    re.compile(r"/actions/(?P<action>.+)"): Resource.ACTION,
}
"""The ways to read the path of an action, the longest address below it first."""


def route_of(method: str, path: str, served: Container[str]) -> Route:
    """Return what a request is about, by the path below the root of the application.

    `served` has the names of the actions that are served.

    Raises:
        Refused: Nothing is there, or it does not have this method.
    """
    route = _route_of(path, served)
    if method not in METHODS[route.resource]:
        allowed = allowed_at(path, served)
        text = f"{excerpt(path)} has the methods {allowed}, and not {excerpt(method)}"
        if path.endswith("/cancel"):
            text += f": to cancel a goal, send DELETE to {excerpt(path.removesuffix('/cancel'))}"
        raise Refused(405, text, ("Allow", allowed))
    return route


def allowed_at(path: str, served: Container[str]) -> str:
    """Return the methods of what is at a path, for the header `Allow`.

    Raises:
        Refused: Nothing is there.
    """
    own = METHODS[_route_of(path, served).resource]
    head = ("HEAD",) if "GET" in own else ()
    return ", ".join([*own[:1], *head, *own[1:], "OPTIONS"])


def check_parameters(query: Iterable[str], route: Route, method: str) -> None:
    """Check that a request has no parameter which would not count.

    Raises:
        Refused: It has one; the text names those that there are.
    """
    known = PARAMETERS.get((route.resource, method), ())
    for name in query:
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known) or 'none'}"
            raise Refused(400, f"{method} has no parameter {excerpt(name)!r} here: {hint}")


def _route_of(path: str, served: Container[str]) -> Route:
    if path == "/openapi.json":
        return Route(Resource.DESCRIPTION)
    if path == "/actions":
        return Route(Resource.ACTIONS)
    if path == "/goals":
        return Route(Resource.SEARCH)
    readings = [
        (resource, found["action"], found.groupdict().get("goal"))
        for pattern, resource in _PATHS.items()
        if (found := pattern.fullmatch(path))
    ]
    if not readings:
        raise Refused(404, f"there is nothing at {excerpt(path)}: see /openapi.json")
    usable = (one for one in readings if one[1] in served and (one[2] is None or _parsed(one[2])))
    resource, action, goal = next(usable, readings[0])
    if goal is None:
        return Route(resource, action)
    goal_id = _parsed(goal)
    if goal_id is None:
        raise Refused(400, f"a goal ID has 32 hexadecimal digits, unlike {excerpt(goal)!r}")
    if goal_id == NO_GOAL:
        raise Refused(400, "the goal ID of zeros means all goals: it has no address")
    return Route(resource, action, goal_id)


def _parsed(text: str) -> GoalID | None:
    try:
        return GoalID.parse(text)
    except ValueError:
        return None
