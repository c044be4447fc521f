"""The source of a record's facts: the decisions of servers, the states of connections, and the log.

It wraps methods of the product. The wrappers call the real methods, and change nothing.
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeAlias
from unittest.mock import patch

from msgspec.structs import astuple

from fibaction import ActionError, ActionServer, GoalID, Outcome, ProtocolError
from fibaction.border.abc import GoalStream
from fibaction.border.goal_store import StoredGoal
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.execution.executor import Execution, Run
from fibaction.server.execution.runs import Runs
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import Ending, GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.server.scheduling.goal_dispatcher import GoalDispatcher
from fibaction.server.scheduling.scheduled_goals import Busy
from fibaction.wire.client.connection import RemoteConnection
from fibaction.wire.client.reconnect import Reconnector
from fibaction.wire.messages import (
    CancelAnswered,
    Ended,
    Feedback,
    Following,
    GoalChanged,
    StatusChanged,
    decode_from_server,
)
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.requests import Answer
from fibaction.wire.server.session import Session
from fibaction.wire.server.subscriptions import GoalSubscription, HeldGoals
from fibaction.wire.wire_server import WireServer
from tests.simulation.facts import Truth
from tests.simulation.invariants import Record
from tests.simulation.scenario import ON_PURPOSE, SIMULATED, Work

AnyRuns: TypeAlias = Runs[Any, Any, Any]
LONGEST_LINE = 1000
"""Characters of a line of the log, at most: some words of the server, and excerpts of a client's
texts."""


Wrapper: TypeAlias = Callable[..., Any]
WRAPPERS: list[tuple[type, str, Wrapper]] = []
"""The methods of the product that are wrapped, each with its wrapper."""


def wrapping(cls: type, method: str) -> Callable[[Wrapper], Wrapper]:
    """Register a wrapper of a method, which takes the record and the real method before the
    method's own arguments.
    """

    def register(wrapper: Wrapper) -> Wrapper:
        WRAPPERS.append((cls, method, wrapper))
        return wrapper

    return register


@contextmanager
def recorded(
    record: Record,
    on_hub: Callable[[WireServer], None],
    on_message: Callable[[Session], None],
    on_hold: Callable[[FeedbackLog[Any]], None],
) -> Generator[None, None, None]:
    """Report decisions of servers and states of connections to the record, in the block.

    `on_message` is called after each message of a client, and `on_hold` when an executor begins to
    wait for a client.
    """

    def wrapped(real: Any, wrapper: Wrapper) -> Wrapper:
        return lambda self, *args, **keywords: wrapper(record, real, self, *args, **keywords)

    def telling(call: Callable[[Any], None]) -> Wrapper:
        def wrapper(_record: Record, real: Any, self: Any, *args: Any, **keywords: Any) -> Any:
            found = real(self, *args, **keywords)
            call(self)
            return found

        return wrapper

    wrappers = [
        *WRAPPERS,
        (WireServer, "__init__", telling(on_hub)),
        (Session, "_handle", telling(on_message)),
        (FeedbackLog, "_has_room_within", telling(on_hold)),
    ]
    with ExitStack() as stack:
        for cls, name, wrapper in wrappers:
            stack.enter_context(patch.object(cls, name, wrapped(getattr(cls, name), wrapper)))
        yield


# Goals


def _truth(record: Record, goal: GoalRecord) -> Truth:
    return next(truth for truth in record.truths(goal.goal_id, goal.stamp) if truth.goal is goal)


@wrapping(GoalRegistry, "accept")
def _accept(record: Record, real: Any, self: GoalRegistry, goal: GoalRecord) -> None:
    real(self, goal)
    life = record.life_of(self)
    record.accepted(life, goal.goal_id, goal.stamp, str(goal.sender))
    life.goals[goal.goal_id, goal.stamp].goal = goal


@wrapping(GoalRegistry, "restore")
def _restore(
    record: Record, real: Any, self: GoalRegistry, stored: StoredGoal, **keywords: Any
) -> GoalRecord:
    goal: GoalRecord = real(self, stored, **keywords)
    record.restored(record.life_of(self), goal)
    return goal


@wrapping(GoalRegistry, "execute")
def _execute(record: Record, real: Any, self: GoalRegistry, goal: GoalRecord) -> None:
    real(self, goal)
    record.changed(_truth(record, goal), goal.status)


@wrapping(GoalRegistry, "finish")
def _finish(
    record: Record,
    real: Any,
    self: GoalRegistry,
    goal: GoalRecord,
    outcome: Outcome[bytes],
    **when: Any,
) -> None:
    real(self, goal, outcome, **when)
    truth = _truth(record, goal)
    record.changed(truth, goal.status)
    record.ended(truth, outcome, goal.feedback_count)


@wrapping(Cancellation, "accept")
def _cancel(record: Record, real: Any, self: Cancellation, goal: GoalRecord) -> bool:
    accepted: bool = real(self, goal)
    record.changed(_truth(record, goal), goal.status)
    return accepted


# Schedules: what servers give, take and interrupt


def _truth_of(record: Record, runs: AnyRuns, goal_id: GoalID) -> Truth | None:
    run = runs._runs.get(goal_id)
    return None if run is None else record.truth(goal_id, run.goal.stamp)


@wrapping(GoalDispatcher, "offer")
def _offer(
    record: Record, real: Any, self: GoalDispatcher[Any], goal_id: GoalID, work: Work, *args: Any
) -> Any:
    life = record.life_of(self)
    record.places.offered(life, goal_id, work)
    try:
        return real(self, goal_id, work, *args)
    except Busy as busy:
        record.places.rejected(life, goal_id, str(busy))
        raise


@wrapping(Runs, "_call")
def _begin_run(record: Record, real: Any, self: AnyRuns, run: Run[Any, Any, Any]) -> None:
    truth = record.truth(run.goal.goal_id, run.goal.stamp)
    if truth is not None:
        record.places.begun(truth)
    real(self, run)


@wrapping(Runs, "interrupt")
def _interrupt(record: Record, real: Any, self: AnyRuns, goal_id: GoalID, reason: str) -> None:
    truth = _truth_of(record, self, goal_id)
    if truth is not None:
        record.places.interrupted(truth, reason)
    real(self, goal_id, reason)


@wrapping(Runs, "kill")
def _kill(
    record: Record, real: Any, self: AnyRuns, goal_id: GoalID, reason: str = "", *, for_good: bool
) -> None:
    truth = _truth_of(record, self, goal_id)
    if truth is not None and not for_good:
        record.places.killed(truth)
    real(self, goal_id, reason, for_good=for_good)


@wrapping(Runs, "take_over")
def _take_over(
    record: Record, real: Any, self: AnyRuns, goal_id: GoalID, successor: GoalID
) -> None:
    old, new = _truth_of(record, self, goal_id), _truth_of(record, self, successor)
    assert old is not None
    assert new is not None
    if old.result is None:  # else it fails
        record.places.taken_over(old, new)
    real(self, goal_id, successor)
    if old.outcome is None and record.scenario.server.store is None:
        record.fail("turn", f"goal {goal_id} goes on beside the one that it has taken over")


@wrapping(Runs, "_end")
def _end(
    record: Record, real: Any, self: AnyRuns, execution: Execution[Any, Any, Any], ending: Ending
) -> None:
    truth = record.truth(execution.handle.goal_id, execution.handle.stamp)
    if truth is not None and not truth.starts:
        record.places.left(truth)
    real(self, execution, ending)


# Connections


@wrapping(RemoteConnection, "_attempt")
async def _attempt(record: Record, real: Any, self: RemoteConnection) -> ActionError:
    error: ActionError = await real(self)
    state = record.clients[_name_in(self._url)]
    if state.is_ready:
        state.is_ready, state.lost_at = False, record.now()
        state.losses += 1
    else:
        state.has_failed = True
    record.tell(f"{state.plan.name} has no connection: {error}")
    if record.scenario.climate == "calm" and not (state.is_leaving or record.is_stopping):
        record.fail("peace", f"{state.plan.name} has lost its connection: {error}")
    if isinstance(error, ProtocolError) and not _is_lines_fault(error, record):
        record.fail("error", f"{state.plan.name}'s connection ended: {error}")
    state.is_final = isinstance(error, ProtocolError) or not state.plan.reconnect
    return error


def _is_lines_fault(error: ProtocolError, record: Record) -> bool:
    """Return whether the error may be caused by a frozen line, and not by a wrong message."""
    what, scenario = str(error), record.scenario
    is_late = "has not said hello" in what
    is_much = "asks for more than it reads" in what and scenario.server.queue < 10_000
    return scenario.climate != "calm" and (is_late or is_much)


@wrapping(RemoteConnection, "_begin")
def _begin(record: Record, real: Any, self: RemoteConnection, welcome: Any) -> None:
    state = record.clients[_name_in(self._url)]
    state.is_ready = state.was_ready = True
    state.has_failed, state.lost_at = False, math.inf
    real(self, welcome)


@wrapping(Reconnector, "_give_up")
def _give_up(record: Record, real: Any, self: Reconnector, error: ActionError) -> None:
    state = record.clients[_name_in(self._url)]
    if state.is_absent(record.now()):  # else it is too early, and no excuse
        state.absent_at = record.now()
    real(self, error)


@wrapping(Session, "run")
async def _run(record: Record, real: Any, self: Session) -> ActionError:
    peer = self._link.peer
    error: ActionError = await real(self)
    record.tell(f"the server's connection with {peer} ended: {error}")
    is_hostile = peer.startswith("hostile-")
    if isinstance(error, ProtocolError) and not (is_hostile or _is_lines_fault(error, record)):
        record.fail("error", f"the server's connection with {peer} ended: {error}")
    return error


@wrapping(Owners, "lose")
def _lose(record: Record, real: Any, self: Owners, held: HeldGoals, *, left: bool) -> None:
    for call in held.calls.values():
        if call.own:
            record.orphaned(GoalID(call.goal_id))
    real(self, held, left=left)


@wrapping(Owners, "own")
def _own(
    record: Record, real: Any, self: Owners, call: GoalSubscription, stream: GoalStream, *rest: Any
) -> bool:
    is_own: bool = real(self, call, stream, *rest)
    if is_own:
        record.owned(stream.goal_id)
    return is_own


# What servers with a store tell their clients


@wrapping(GoalSubscription, "next_frames")
def _next_frames(record: Record, real: Any, self: GoalSubscription) -> list[bytes]:
    frames: list[bytes] = real(self)
    if record.scenario.server.store is None or self.stream is None:
        return frames
    if not isinstance(self.endpoint, ActionServer):
        return frames
    life = record.life_of(self.endpoint._dispatcher)
    goal_id, stamp = GoalID(self.goal_id), self.stream.stamp
    for frame in frames:
        message = decode_from_server(frame)
        if isinstance(message, Following | StatusChanged):
            record.keeping.told(life, goal_id, stamp, message.status)
        elif isinstance(message, Ended):
            _, status, result, reason, _, *more = astuple(message)
            outcome = Outcome(status, result, reason, *more)
            record.keeping.told(life, goal_id, stamp, status, outcome)
        elif isinstance(message, Feedback):
            attempt = SIMULATED.feedback.decode(message.payload).attempt
            record.keeping.told_feedback(life, goal_id, stamp, attempt)
    return frames


@wrapping(Session, "_say")
async def _say(record: Record, real: Any, self: Session, answer: Answer) -> None:
    if record.scenario.server.store is not None:
        (server,) = self._handlers._endpoints.values()
        assert isinstance(server, ActionServer)
        life = record.life_of(server._dispatcher)
        if isinstance(answer, GoalChanged):
            record.keeping.told(life, GoalID(answer.goal_id), answer.stamp, answer.status)
        elif isinstance(answer, CancelAnswered):
            for goal_id, stamp, status in answer.goals:
                record.keeping.told(life, GoalID(goal_id), stamp, status)
    await real(self, answer)


def _name_in(where: str) -> str:
    return where.rpartition("/")[2]


class _Log(logging.Handler):
    """A handler that adds log records to the trace."""

    def __init__(self, record: Record) -> None:
        super().__init__()
        self._record = record

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        self._record.tell(f"log {record.levelname} {text}")
        if not text.isprintable() or len(text) > LONGEST_LINE:
            self._record.fail("log", f"a client has formed this line: {text!r}")
        wanted = ON_PURPOSE in text or ON_PURPOSE in str(record.exc_info and record.exc_info[1])
        if record.levelno >= logging.ERROR and not wanted:
            more = logging.Formatter().formatException(record.exc_info) if record.exc_info else ""
            self._record.fail("log", f"{text}\n{more}")


@contextmanager
def listening(record: Record) -> Generator[None, None, None]:
    """Report the log, and errors that Python can only print, to the record, in the block."""
    logger = logging.getLogger("fibaction")
    handler = _Log(record)
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False

    def unraisable(what: Any) -> None:
        record.fail("log", f"{what.exc_value!r} was raised in {what.object!r}, and ignored")

    try:
        with patch.object(sys, "unraisablehook", unraisable):
            yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]


def lost(record: Record, context: dict[str, Any]) -> None:
    error = context.get("exception")
    record.fail("log", f"{context['message']}: {error!r}")
