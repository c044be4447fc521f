"""`fibaction_transports.web.rest.routes`."""

from __future__ import annotations

import pytest

from fibaction import GoalID
from fibaction.border.http_access import Refused
from fibaction_transports.web.rest.routes import Resource, Route, route_of

ID = "0123456789abcdef0123456789abcdef"


@pytest.mark.parametrize(
    ("path", "route"),
    [
        ("/openapi.json", Route(Resource.DESCRIPTION)),
        ("/actions", Route(Resource.ACTIONS)),
        ("/actions/arm/pick", Route(Resource.ACTION, "arm/pick")),
        ("/actions//arm/pick/goals", Route(Resource.GOALS, "/arm/pick")),
        (f"/actions/~/arm/goals/{ID}", Route(Resource.GOAL, "~/arm", GoalID.parse(ID))),
        (f"/actions/goals/goals/{ID}/events", Route(Resource.EVENTS, "goals", GoalID.parse(ID))),
    ],
)
def test_a_path_is_read_from_its_right_end(path: str, route: Route) -> None:
    assert route_of("GET", path, ()) == route


@pytest.mark.parametrize(
    ("path", "served", "route"),
    [
        ("arm/goals", ["arm/goals"], Route(Resource.ACTION, "arm/goals")),
        ("arm/goals", ["arm", "arm/goals"], Route(Resource.GOALS, "arm")),
        ("arm/goals/goals", ["arm", "arm/goals"], Route(Resource.GOALS, "arm/goals")),
        ("arm/goals/goals", ["arm", "arm/goals/goals"], Route(Resource.ACTION, "arm/goals/goals")),
        ("arm/goals/x", ["arm", "arm/goals/x"], Route(Resource.ACTION, "arm/goals/x")),
        ("arm/goals/events", ["arm/goals/events"], Route(Resource.ACTION, "arm/goals/events")),
        (
            f"arm/goals/goals/{ID}",
            ["arm", "arm/goals"],
            Route(Resource.GOAL, "arm/goals", GoalID.parse(ID)),
        ),
        (
            f"arm/goals/{ID}/events",
            ["arm", "arm/goals"],
            Route(Resource.EVENTS, "arm", GoalID.parse(ID)),
        ),
    ],
)
def test_the_first_way_to_read_a_path_whose_action_is_served_counts(
    path: str, served: list[str], route: Route
) -> None:
    assert route_of("GET", f"/actions/{path}", served) == route


@pytest.mark.parametrize(
    "path", ["", "/", "/x", "/../actions", "/actions/", "/openapi.json/", "/actionsx"]
)
def test_elsewhere_there_is_nothing(path: str) -> None:
    with pytest.raises(Refused, match=r"see /openapi\.json") as refused:
        route_of("GET", path, ())
    assert refused.value.status == 404


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("POST", "/actions", "GET"),
        ("PUT", "/actions/a/goals", "GET, POST, DELETE"),
        ("POST", f"/actions/a/goals/{ID}", "GET, PUT, DELETE"),
        ("\x1b", f"/actions/a/goals/{ID}/events", "GET"),
    ],
)
def test_another_method_gets_the_list_of_those_that_are(
    method: str, path: str, allowed: str
) -> None:
    with pytest.raises(Refused) as refused:
        route_of(method, path, ())
    assert refused.value.status == 405
    assert refused.value.headers == (("Allow", allowed),)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("text", "problem"), [("x", "has 32 hexadecimal digits"), ("0" * 32, "means all goals")]
)
def test_an_id_that_is_none_is_told(text: str, problem: str) -> None:
    with pytest.raises(Refused, match=problem) as refused:
        route_of("DELETE", f"/actions/a/goals/{text}", ["a"])
    assert refused.value.status == 400
