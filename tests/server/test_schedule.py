"""`fibaction.Schedule`: what is wrong in a schedule is said when it is made."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from fibaction import Schedule
from tests.support.fibonacci import Goal

WORDS = "when_full must be 'reject', 'preempt' or 'replace', not "


async def waits(goal: Goal) -> int:
    return 1


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"concurrency": 0}, "concurrency must be 1 or more, not 0"),
        ({"concurrency": -1}, "concurrency must be 1 or more, not -1"),
        ({"total": 0}, "total must be 1 or more, not 0"),
        ({"concurrency": 1, "queue": -1}, "queue must be 0 or more, not -1"),
        ({"queue": 1}, "queue=1 needs a limit: set concurrency or total, too"),
        (
            {"when_full": "preempt"},
            "when_full='preempt' needs a limit: set concurrency or total, too",
        ),
        ({"concurrency": 1, "when_full": "pre-empt"}, f"{WORDS}'pre-empt'"),
        ({"concurrency": 1, "when_full": None}, f"{WORDS}None"),
        (
            {"concurrency": 1, "when_full": "replace"},
            "when_full='replace' needs a queue of at least 1, not 0",
        ),
        (
            {"key": str, "priority": str},
            "priority needs a limit: set concurrency or total, too",
        ),
        (
            {"concurrency": 1, "queue_timeout": 0.5},
            "queue_timeout=0.5 needs a queue of at least 1, not 0",
        ),
        (
            {"concurrency": 1, "skip_expired": True},
            "skip_expired=True needs a queue of at least 1, not 0",
        ),
        (
            {"skip_expired": True},
            "skip_expired=True needs a limit: set concurrency or total, too",
        ),
        ({"queue_timeout": 0}, "queue_timeout must be more than 0, not 0"),
        ({"queue_timeout": math.nan}, "queue_timeout must be more than 0, not nan"),
        ({"run_timeout": -0.5}, "run_timeout must be more than 0, not -0.5"),
        ({"handover": -1}, "handover must be 0 or more, not -1"),
        ({"handover": math.nan}, "handover must be 0 or more, not nan"),
        ({"concurrency": 1, "handover": 2.5}, "handover=2.5 needs when_full='preempt'"),
        (
            {"concurrency": 1, "queue": 1, "when_full": "replace", "handover": math.inf},
            "handover=inf needs when_full='preempt'",
        ),
    ],
)
def test_a_value_out_of_range_is_rejected_with_what_to_do(settings: Any, text: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(text)}$"):
        Schedule(**settings)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"concurrency": 1.0}, "concurrency must be a whole number, not 1.0"),
        ({"concurrency": True}, "concurrency must be a whole number, not True"),
        ({"total": "2"}, "total must be a whole number, not '2'"),
        ({"concurrency": 1, "queue": None}, "queue must be a whole number, not None"),
        ({"concurrency": 1, "queue": math.inf}, "queue must be a whole number, not inf"),
        ({"key": "arm"}, "key is a function of a goal, or of a goal and its sender, not 'arm'"),
        ({"run_timeout": "60"}, "run_timeout must be a number of seconds, not '60'"),
        ({"queue_timeout": None}, "queue_timeout must be a number of seconds, not None"),
        ({"concurrency": 1, "skip_expired": 1}, "skip_expired must be True or False, not 1"),
        ({"handover": "1"}, "handover must be a number of seconds, not '1'"),
        ({"key": waits}, "key must be a function without `async`, which does not wait"),
        ({"priority": waits}, "priority must be a function without `async`, which does not wait"),
        ({"priority": 3}, "priority is a function of a goal, or of a goal and its sender, not 3"),
    ],
)
def test_a_value_of_another_type_is_rejected_with_what_to_do(settings: Any, text: str) -> None:
    with pytest.raises(TypeError, match=f"^{re.escape(text)}$"):
        Schedule(**settings)
