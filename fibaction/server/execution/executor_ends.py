"""The ends of executors: those by an error, and the abandonment of those that survive a kill.

The coroutine of an abandoned executor is kept forever, because Python would otherwise close it, and
run its clean-up in the middle of something else.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar, cast

from anyio import get_cancelled_exc_class

from fibaction._runtime.log import clean_logger
from fibaction.server.life import Phase
from fibaction.server.registry.goal_record import Ending, EndKind
from fibaction.types.ros_classes import is_message, ros_type_of
from fibaction.words.errors import FAILURES, GoalAborted, GoalCanceled, GoalRejected, text_of
from fibaction.words.goals import GoalID
from fibaction.words.statuses import GoalStatus

if TYPE_CHECKING:
    from fibaction.server.registry.goal_record import GoalRecord
    from fibaction.types.action import Action


logger = clean_logger("fibaction.server")


CANCELED_UNASKED = "its code ended as canceled, but no cancel was requested"


GENERATOR = "the executor is wrong: it"


class Misuse(Exception):
    """A rule of executors that the user's generator or function broke."""

    def __init__(self, text: str, subject: str = GENERATOR) -> None:
        super().__init__(f"{subject} {text}")


def is_feedback_message(item: object, action: Action[Any, Any, Any]) -> bool:
    """Return whether an item that is of neither type is a ROS message for feedback, not a result.

    Raises:
        Misuse: It is for neither, or could be for both.
    """
    feedback, result = action.feedback.accepts(item), action.result.accepts(item)
    if feedback and result:
        raise Misuse(
            f"yielded {kind_of(item)}, which could be feedback or a result:"
            " mark the result with `Return(...)`"
        )
    if not feedback and not result:
        raise Misuse(
            f"yielded {kind_of(item)}, which is neither feedback ({action.feedback.type_text}) nor"
            f" a result ({action.result.type_text})"
        )
    return feedback


def no_result(action: Action[Any, Any, Any], feedback_count: int) -> Misuse:
    """Return the error of an executor that has ended without a result."""
    if feedback_count and action.is_ambiguous:
        return Misuse(
            "ended without yielding a result; its feedback and its result have one type, so mark"
            " the result: `Return(...)`"
        )
    return Misuse("ended without yielding a result")


def wrong_result(value: object, action: Action[Any, Any, Any], subject: str) -> Misuse:
    """Return the error of an executor whose result is of another type."""
    hint = ": is a return missing?" if value is None and subject != GENERATOR else ""
    text = f"returned {kind_of(value)}, and its result is {action.result.type_text}{hint}"
    return Misuse(text, subject)


def cause_of(exc: BaseException) -> BaseException | None:
    """Return the error, out of any exception group around it; None if it is a cancellation."""
    canceled = get_cancelled_exc_class()
    if isinstance(exc, canceled):
        return None
    if not isinstance(exc, BaseExceptionGroup):
        return exc
    group = cast("BaseExceptionGroup[BaseException]", exc)
    rest = group.split(canceled)[1]
    if rest is None:
        return None
    first, *others = rest.exceptions
    return rest if others else cause_of(first)


def kind_of(value: object) -> str:
    """Return the class of a value with its article, for the text of an error."""
    if is_message(value):
        return f"the ROS message {ros_type_of(type(value))}"
    if value is None:
        return "None"
    name = type(value).__qualname__
    return f"an {name}" if name[0] in "AEIOUaeiou" else f"a {name}"


def error_end(
    cause: BaseException, action: Action[Any, Any, Any], goal: GoalRecord, result: bytes | None
) -> Ending:
    """Return the end of an executor that has raised an error, and log those that are unexpected.

    `result` is what it has yielded as its result before; None if nothing.
    """
    if isinstance(cause, GoalCanceled):
        return _partial_end(EndKind.CANCELED, cause, action, goal, result)
    if isinstance(cause, GoalAborted):
        return _partial_end(EndKind.FAILED, cause, action, goal, result)
    return failed(cause, action, goal, result)


def _partial_end(
    kind: EndKind,
    exc: GoalCanceled | GoalAborted,
    action: Action[Any, Any, Any],
    goal: GoalRecord,
    result: bytes | None,
) -> Ending:
    """Return the end of an executor that has handed a partial result over with its error."""
    codec = action.result
    if exc.result is None:
        return Ending(kind, result, exc.reason)
    if not codec.accepts(exc.result):
        # Usually the error of another goal that the executor sent, and did not catch.
        left_out = f"its result is left out: {kind_of(exc.result)} is not {codec.type_text}"
        reason = f"{exc.reason} ({left_out})" if exc.reason else left_out
        _log_failure(f"{type(exc).__name__}: {reason}", exc, action.name, goal)
        return Ending(kind, result, reason)
    try:
        return Ending(kind, codec.encode(exc.result), exc.reason)
    except FAILURES as bad:  # encoding runs the user's own code, which may raise anything
        return failed(bad, action, goal, result)


def failed(
    exc: BaseException, action: Action[Any, Any, Any], goal: GoalRecord, result: bytes | None = None
) -> Ending:
    """Return the end of an executor by another error, and log it."""
    if isinstance(exc, Misuse):
        reason = str(exc)
    else:
        text = text_of(exc)  # what the user's class has as `__str__` may raise
        reason = text + _hint(exc, text, action)
    _log_failure(reason, exc, action.name, goal)
    return Ending(EndKind.FAILED, result, reason)


def _hint(exc: BaseException, text: str, action: Action[Any, Any, Any]) -> str:
    """Return what to write in place of what was probably meant; empty if it is not known."""
    if isinstance(exc, GoalRejected) and exc.goal_id is None:  # not of a goal that was sent
        return " (the goal is accepted by now: raise GoalAborted here, or reject it in on_goal)"
    if not isinstance(exc, TypeError | AttributeError):
        return ""
    if any(part in text for part in ("'Report'", "object Report ", "Report.__call__")):
        return " (a report is called with one feedback: `await report(feedback)`)"
    if "'GoalHandle'" in text:
        return " (what the client sent is goal.request)"
    for kind in action.goal.classes:
        fields = getattr(kind, "__annotations__", ())
        if fields and f"'{kind.__name__}'" in text:
            return f" ({kind.__name__} has the fields {', '.join(fields)})"
    return ""


def _log_failure(reason: str, exc: BaseException, action: str, goal: GoalRecord) -> None:
    if goal.phase is Phase.LOST:
        return  # it was interrupted, and could not keep its checkpoint
    logger.error("goal %s of action %r failed: %s", goal.goal_id, action, reason, exc_info=exc)


def is_kept(goal: GoalRecord, ending: Ending, *, killed: bool) -> bool:
    """Return whether a goal stays in the store that was interrupted for that: it has not ended by
    itself, and nobody has canceled it.
    """
    has_ended = not killed and ending.kind is not EndKind.CANCELED
    return not has_ended and goal.status is not GoalStatus.CANCELING


T = TypeVar("T")

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
