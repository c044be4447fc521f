"""`fibaction.client.retry`: the checks of a rule, its delays, and the errors that it is for."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fibaction import (
    AuthenticationFailed,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalTimeout,
    LimitReached,
    RejectionCode,
    Retry,
    ServerNotFound,
    TransportError,
    UnknownGoal,
)

AFTER_A_RUN = "such a goal has run, or may have, and running it again is the caller's decision"
ALL = "ServerNotFound, ConnectionLost, LimitReached, GoalRejected"


def test_a_rule_has_values_that_suit_most() -> None:
    retry = Retry()
    assert (retry.attempts, retry.delay, retry.max_delay) == (3, 0.5, 10.0)
    assert retry.on == (ServerNotFound, ConnectionLost, LimitReached, GoalRejected)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"attempts": 0}, "attempts must be 1 or more, not 0"),
        ({"delay": -1}, "delay must be a number of seconds, 0 or more, not -1"),
        ({"delay": math.nan}, "delay must be a number of seconds, 0 or more, not nan"),
        ({"max_delay": math.inf}, "max_delay must be a number of seconds, 0 or more, not inf"),
        ({"delay": 20.0}, "max_delay must be at least the delay of 20 s, not 10 s"),
        *(
            ({"on": (kind,)}, f"on does not take {kind.__name__}: {AFTER_A_RUN}; on takes {ALL}")
            for kind in (GoalAborted, GoalCanceled, GoalTimeout, UnknownGoal)
        ),
        *(
            ({"on": (ServerNotFound, kind)}, f"on does not take {kind.__name__}, only {ALL}")
            for kind in (AuthenticationFailed, TransportError, ValueError)
        ),
        ({"on": ("busy",)}, f"on does not take 'busy', only {ALL}"),
    ],
)
def test_a_value_that_is_wrong_is_one_sentence(values: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError) as caught:
        Retry(**values)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"attempts": 1.5}, "attempts must be a whole number, not 1.5"),
        (
            {"on": ServerNotFound},
            (
                "on must be a tuple of error classes, such as (ServerNotFound,), not"
                f" {ServerNotFound!r}"
            ),
        ),
    ],
)
def test_a_value_of_the_wrong_type_is_one_sentence(values: dict[str, Any], text: str) -> None:
    with pytest.raises(TypeError) as caught:
        Retry(**values)
    assert str(caught.value) == text


def test_the_delays_double_up_to_the_longest_and_are_shortened_by_chance() -> None:
    retry = Retry(delay=1.0, max_delay=5.0)
    for attempt, longest in ((2, 1.0), (3, 2.0), (4, 4.0), (5, 5.0), (9, 5.0), (10**6, 5.0)):
        delays = [retry.delay_before(attempt) for _ in range(50)]
        assert longest / 2 <= min(delays) < max(delays) <= longest
    assert Retry(delay=0).delay_before(3) == 0


def test_a_rule_is_for_its_errors_and_of_rejections_for_those_of_a_busy_server() -> None:
    busy, no = GoalRejected("1 of 1 running", code=RejectionCode.BUSY), GoalRejected("too far")
    assert (busy.is_busy, no.is_busy) == (True, False)
    for error in (busy, ServerNotFound(""), ConnectionLost(""), LimitReached("")):
        assert Retry().is_for(error)
        assert Retry(on=(type(error),)).is_for(error)
        assert not Retry(on=()).is_for(error)
    for other in (no, TransportError(""), AuthenticationFailed(""), GoalAborted("busy")):
        assert not Retry().is_for(other)
