"""Executors that do not end though they are killed: those that are spared, and those abandoned.

The coroutine of an abandoned executor is kept forever, because Python would otherwise close it, and
run its clean-up in the middle of something else.
"""

from __future__ import annotations

import sys
from typing import Generic, NoReturn, TypeVar

from fibaction._runtime.log import clean_logger
from fibaction.words.goals import GoalID

T = TypeVar("T")

logger = clean_logger("fibaction.server")

MOST_KILLS = 100
"""The cancellations that a killed coroutine gets before it is abandoned: each of its nested blocks
may await something in its clean-up, and needs one of them."""

_kept: list[object] = []


def keep_for_ever(coroutine: object) -> None:
    """Keep a coroutine from being closed, even at the end of the process.

    To close it is to raise GeneratorExit in it. It may catch that, too, and as no event loop runs
    then, an `await` in a loop would fail at once, again and again: the process would never end.
    """
    _kept.append(coroutine)
    # Others do not close what is left at their end.
    if sys.implementation.name == "cpython":  # pragma: no branch  # as it is wherever tests run
        from ctypes import py_object, pythonapi

        pythonapi.Py_IncRef(py_object(coroutine))


class AbandonedCoroutine(Generic[T]):
    """In place of a coroutine that was abandoned: it returns a value at once."""

    def __init__(self, value: T) -> None:
        self._value = value

    def send(self, value: object) -> NoReturn:
        raise StopIteration(self._value)

    def throw(self, error: object, value: object = None, traceback: object = None) -> NoReturn:
        raise StopIteration(self._value)

    def close(self) -> None:
        """Do nothing: the coroutine must not be closed."""


def warn_of_kill(goal_id: GoalID, action: str, timeout: float) -> None:
    """Log that a goal is killed, which was interrupted `timeout` seconds ago."""
    logger.warning(
        "goal %s of action %r did not stop in time (%g s), and is killed", goal_id, action, timeout
    )
