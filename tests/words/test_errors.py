from __future__ import annotations

import inspect
import pickle
from collections.abc import Iterator
from typing import Any

import pytest

from fibaction.words import errors
from fibaction.words.errors import (
    ActionError,
    AuthenticationFailed,
    CancelRejected,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalTimeout,
    InvalidMessage,
    InvalidTransition,
    InvalidURL,
    LimitReached,
    ProtocolError,
    RejectionCode,
    ServerFailed,
    ServerNotFound,
    TransportError,
    UnknownGoal,
    copy_of,
    text_of,
)
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalEvent, GoalStatus
from tests.support.executors import Mute

GOAL_ID = GoalID(bytes(range(16)))
HEX = "000102030405060708090a0b0c0d0e0f"


def public_errors() -> Iterator[tuple[str, type[BaseException]]]:
    for name, value in vars(errors).items():
        if inspect.isclass(value) and issubclass(value, BaseException) and name[0] != "_":
            yield name, value


@pytest.mark.promise("ERROR-1")
@pytest.mark.parametrize(
    ("error", "parent"),
    [
        (ActionError, Exception),
        (GoalRejected, ActionError),
        (GoalAborted, ActionError),
        (GoalCanceled, ActionError),
        (GoalTimeout, ActionError),
        (GoalTimeout, TimeoutError),
        (CancelRejected, ActionError),
        (UnknownGoal, ActionError),
        (InvalidTransition, ActionError),
        (ProtocolError, ActionError),
        (InvalidMessage, ProtocolError),
        (TransportError, ActionError),
        (InvalidURL, TransportError),
        (LimitReached, TransportError),
        (ServerFailed, TransportError),
        (ServerNotFound, TransportError),
        (ConnectionLost, TransportError),
        (AuthenticationFailed, TransportError),
    ],
)
def test_the_tree_is_as_drawn(error: type[BaseException], parent: type[BaseException]) -> None:
    assert parent in {
        base if base.__name__[0] != "_" else base.__mro__[1] for base in error.__bases__
    }


def test_the_drawing_shows_every_error_and_each_has_a_docstring() -> None:
    drawn = inspect.getdoc(errors)
    assert drawn is not None
    for name, error in public_errors():
        assert f" {name}" in drawn
        assert error.__doc__


@pytest.mark.promise("ERROR-1")
@pytest.mark.parametrize(
    ("error", "text"),
    [
        (GoalRejected("too far"), "too far"),
        (GoalRejected("too far", goal_id=GOAL_ID), f"goal {HEX} was rejected: too far"),
        (GoalRejected("", goal_id=GOAL_ID), f"goal {HEX} was rejected"),
        (GoalRejected(""), "the goal was rejected"),
        (GoalAborted("stuck"), "stuck"),
        (GoalAborted("stuck", goal_id=GOAL_ID), f"goal {HEX} was aborted: stuck"),
        (GoalAborted(""), "the goal was aborted"),
        (GoalCanceled(), "the goal was canceled"),
        (GoalCanceled("asked to", goal_id=GOAL_ID), f"goal {HEX} was canceled: asked to"),
        (GoalTimeout("too slow", goal_id=GOAL_ID), f"goal {HEX} timed out: too slow"),
        (GoalTimeout(""), "the goal timed out"),
        (CancelRejected("nearly done"), "nearly done"),
        (CancelRejected("no", goal_id=GOAL_ID), f"goal {HEX} cannot be canceled: no"),
        (CancelRejected(""), "the goal cannot be canceled"),
        (
            UnknownGoal(GOAL_ID),
            (
                f"goal {HEX} is unknown: it was never accepted, its result has expired, or the"
                " server was restarted"
            ),
        ),
        (
            InvalidTransition(GoalStatus.SUCCEEDED, GoalEvent.ABORT),
            "a goal that is SUCCEEDED cannot ABORT",
        ),
        (ProtocolError("no such kind"), "no such kind"),
        (ConnectionLost("the server is gone"), "the server is gone"),
    ],
)
def test_the_text_is_one_sentence_with_what_is_known(error: ActionError, text: str) -> None:
    assert str(error) == text


@pytest.mark.promise("ERROR-2")
def test_data_is_in_attributes() -> None:
    rejected = GoalRejected("too far", goal_id=GOAL_ID)
    assert (rejected.reason, rejected.goal_id) == ("too far", GOAL_ID)
    aborted = GoalAborted("stuck", result=[1], goal_id=GOAL_ID)
    assert (aborted.reason, aborted.result, aborted.goal_id) == ("stuck", [1], GOAL_ID)
    canceled = GoalCanceled("asked to", result=[2], goal_id=GOAL_ID)
    assert (canceled.reason, canceled.result, canceled.goal_id) == ("asked to", [2], GOAL_ID)
    late = GoalTimeout(
        "slow", goal_id=GOAL_ID, status=GoalStatus.EXECUTING, feedback=[3], feedback_count=4
    )
    assert (late.reason, late.goal_id, late.status) == ("slow", GOAL_ID, GoalStatus.EXECUTING)
    assert (late.feedback, late.feedback_count) == ([3], 4)
    assert UnknownGoal(GOAL_ID).goal_id == GOAL_ID
    invalid = InvalidTransition(GoalStatus.ACCEPTED, GoalEvent.SUCCEED)
    assert (invalid.status, invalid.event) == (GoalStatus.ACCEPTED, GoalEvent.SUCCEED)


@pytest.mark.parametrize(
    "error", [GoalRejected, GoalAborted, GoalCanceled, GoalTimeout, CancelRejected]
)
def test_a_reason_is_text_whatever_was_given(error: type[Any]) -> None:
    refusal = error(ValueError("too far"))
    assert refusal.reason == str(refusal) == "too far"


def test_an_error_of_others_is_its_name_and_what_it_says_if_it_can() -> None:
    assert text_of(ValueError("too far")) == "ValueError: too far"
    assert text_of(TimeoutError()) == "TimeoutError"
    assert text_of(SystemExit()) == "sys.exit() was called"
    assert text_of(SystemExit("no arm")) == "sys.exit('no arm') was called"
    assert text_of(Mute("too far")) == "Mute"


@pytest.mark.parametrize(
    "error",
    [
        GoalRejected("too far", goal_id=GOAL_ID),
        GoalAborted("stuck", result=[1], goal_id=GOAL_ID),
        GoalTimeout("slow", goal_id=GOAL_ID, status=GoalStatus.EXECUTING, feedback_count=4),
        GoalCanceled("asked to", result=[2], goal_id=GOAL_ID),
        UnknownGoal(GOAL_ID),
        InvalidTransition(GoalStatus.ACCEPTED, GoalEvent.SUCCEED),
        ServerNotFound("nobody"),
        GoalRejected(reason="too far"),
        UnknownGoal(goal_id=GOAL_ID),
        InvalidTransition(status=GoalStatus.ACCEPTED, event=GoalEvent.SUCCEED),
    ],
    ids=repr,
)
def test_an_error_survives_the_way_to_another_process(error: ActionError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


class WithItsOwnConstructor(ActionError):
    def __init__(self, *, axis: int) -> None:
        super().__init__(f"axis {axis} is stuck")
        self.axis = axis


@pytest.mark.parametrize(
    "error",
    [
        GoalRejected("busy", goal_id=GOAL_ID),
        GoalTimeout("slow", goal_id=GOAL_ID, status=GoalStatus.EXECUTING),
        UnknownGoal(GOAL_ID),
        WithItsOwnConstructor(axis=3),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_copy_of_an_error_says_the_same_and_has_no_traceback(error: ActionError) -> None:
    try:
        raise error
    except ActionError:
        copy = copy_of(error)
    assert copy is not error
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))
    assert copy.__traceback__ is None


@pytest.mark.parametrize("number", [7, 1000, -1])
def test_the_code_of_a_newer_peer_counts_as_a_rejection_without_one(number: int) -> None:
    assert RejectionCode(number) is RejectionCode.REJECTED
    text: Any = "busy"
    with pytest.raises(ValueError, match="busy"):
        RejectionCode(text)
