"""`fibaction_transports.web.rest.routes`."""

from __future__ import annotations

import pytest

from fibaction import GoalID
from fibaction.border.http_access import Refused
from fibaction_transports.web.rest.routes import Resource, Route, route_of

ID = "0123456789abcdef0123456789abcdef"


@pytest.mark.parametrize(
    ("path", "served", "route"),
    [
        ("arm/pick", [], Route(Resource.ACTION, "arm/pick")),
        ("/arm/pick/goals", [], Route(Resource.GOALS, "/arm/pick")),
        (f"~/arm/goals/{ID}", [], Route(Resource.GOAL, "~/arm", GoalID.parse(ID))),
        (f"goals/goals/{ID}/events", [], Route(Resource.EVENTS, "goals", GoalID.parse(ID))),
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
def test_a_path_is_read_from_its_right_end_as_that_of_a_served_action(
    path: str, served: list[str], route: Route
) -> None:
    assert route_of("GET", f"/actions/{path}", served) == route


ONE = f"/actions/a/goals/{ID}"


@pytest.mark.parametrize(
    ("method", "path", "status", "told"),
    [
        *(("GET", path, 404, "see /openapi.json") for path in ("", "/", "/x", "/../actions")),
        *(("GET", path, 404, "see ") for path in ("/actions/", "/openapi.json/", "/actionsx")),
        ("DELETE", "/actions/a/goals/x", 400, "has 32 hexadecimal digits"),
        ("DELETE", f"/actions/a/goals/{'0' * 32}", 400, "means all goals"),
        ("POST", "/actions", 405, "GET, HEAD, OPTIONS"),
        ("PUT", "/actions/a/goals", 405, "GET, HEAD, POST, DELETE, OPTIONS"),
        ("POST", ONE, 405, "GET, HEAD, PUT, DELETE, OPTIONS"),
        ("\x1b", f"{ONE}/events", 405, "GET, HEAD, OPTIONS"),
    ],
)
def test_what_is_not_there_is_told(method: str, path: str, status: int, told: str) -> None:
    with pytest.raises(Refused) as refused:
        route_of(method, path, ["a"])
    assert refused.value.status == status
    assert told in str(refused.value)
    assert str(refused.value).isprintable()
    if status == 405:
        assert refused.value.headers == (("Allow", told),)


def test_who_posts_to_a_cancel_is_told_of_delete() -> None:
    with pytest.raises(Refused, match=f"to cancel a goal, send DELETE to {ONE}$") as refused:
        route_of("POST", f"{ONE}/cancel", ["a"])
    assert refused.value.status == 405
