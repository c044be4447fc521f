"""`fibaction_transports._http.problems`."""

from __future__ import annotations

import json

import pytest

from fibaction import GoalID, GoalRejected, RejectionCode, TransportError
from fibaction.border.http_access import Refused
from fibaction.schema.payload import PayloadError
from fibaction.words.errors import ActionError, ConnectionLost, GoalKept, LimitReached, UnknownGoal
from fibaction.words.goals import ID_IN_USE
from fibaction.words.statuses import GoalEvent, GoalStatus, InvalidTransition
from fibaction_transports._http.problems import RETRY, STATUSES, problem_of

GOAL = GoalID(bytes(15) + b"\1")


@pytest.mark.parametrize(
    ("error", "status", "kind", "detail"),
    [
        (GoalRejected("too far", goal_id=GOAL), 422, "GoalRejected", "too far"),
        (GoalRejected(ID_IN_USE, code=RejectionCode.DUPLICATE), 409, "GoalRejected", ID_IN_USE),
        (GoalRejected("busy: later", code=RejectionCode.BUSY), 503, "GoalRejected", "busy: later"),
        (UnknownGoal(GOAL), 404, "UnknownGoal", str(UnknownGoal(GOAL))),
        (GoalKept("later"), 503, "GoalKept", "later"),
        (ConnectionLost("cut"), 502, "ConnectionLost", "cut"),
        (LimitReached("full"), 429, "LimitReached", "full"),
        (
            InvalidTransition(GoalStatus.ACCEPTED, GoalEvent.EXECUTE),
            500,
            "ServerFailed",
            "a goal that is ACCEPTED cannot EXECUTE",
        ),
        (PayloadError("goal.a is wrong"), 422, "InvalidGoal", "goal.a is wrong"),
        (GoalRejected("a\ud800b"), 422, "GoalRejected", "a?b"),
    ],
)
def test_an_error_has_a_status_and_its_name(
    error: ActionError | PayloadError, status: int, kind: str, detail: str
) -> None:
    problem = problem_of(error)
    told = json.loads(problem.body)
    assert (told["status"], told["type"]) == (status, f"urn:fibaction:{kind}")
    assert told["detail"] == detail
    assert told["title"]
    assert (RETRY in problem.headers) is (status in (429, 503))


def test_a_problem_of_http_has_the_words_of_http() -> None:
    problem = problem_of(Refused(405, "no", ("Allow", "GET")))
    assert json.loads(problem.body) == {
        "type": "about:blank",
        "title": "Method Not Allowed",
        "status": 405,
        "detail": "no",
    }
    assert problem.headers == (("Allow", "GET"),)
    assert json.loads(problem_of(PayloadError("one", "two")).body)["problems"] == ["one", "two"]


def test_every_error_of_a_transport_is_in_the_table() -> None:
    product = {
        kind
        for kind in TransportError.__subclasses__()
        if kind.__module__.startswith("fibaction.") and "testing" not in kind.__module__
    }
    assert {kind.__name__ for kind in product - set(STATUSES)} <= {"InvalidURL"}  # of no request
