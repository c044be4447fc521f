"""The source of a record's facts: the decisions of servers, the states of connections, and the log.

It wraps methods of the product. The wrappers call the real methods, and change nothing.
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from msgspec.structs import astuple

from fibaction import ActionError, ActionServer, GoalID, Outcome, ProtocolError
from fibaction.border.abc import GoalStream
from fibaction.border.goal_store import StoredGoal
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.server.registry.registry import GoalRegistry
from fibaction.wire.client.connection import RemoteConnection
from fibaction.wire.client.reconnect import Reconnector
from fibaction.wire.codec import decode_from_server
from fibaction.wire.messages import (
    CancelAnswered,
    Ended,
    Feedback,
    Following,
    GoalChanged,
    StatusChanged,
)
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.requests import Answer
from fibaction.wire.server.session import Session
from fibaction.wire.server.subscriptions import GoalSubscription, HeldGoals
from fibaction.wire.wire_server import WireServer
from tests.simulation.facts import Truth
from tests.simulation.invariants import Record
from tests.simulation.scenario import ON_PURPOSE, SIMULATED
from tests.simulation.schedule_witness import schedule_wrappers

LONGEST_LINE = 1000
"""Characters of a line of the log, at most: some words of the server, and excerpts of a client's
texts."""


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
    with ExitStack() as stack:

        def wrap(cls: type, name: str, make: Callable[[Any], Any]) -> None:
            stack.enter_context(patch.object(cls, name, make(getattr(cls, name))))

        wrap(GoalRegistry, "accept", lambda real: _accepting(real, record))
        wrap(GoalRegistry, "restore", lambda real: _restoring(real, record))
        wrap(GoalRegistry, "execute", lambda real: _executing(real, record))
        wrap(GoalRegistry, "finish", lambda real: _finishing(real, record))
        wrap(Cancellation, "accept", lambda real: _canceling(real, record))
        for cls, name, make in schedule_wrappers(record):
            wrap(cls, name, make)
        wrap(RemoteConnection, "_attempt", lambda real: _attempting(real, record))
        wrap(RemoteConnection, "_begin", lambda real: _beginning(real, record))
        wrap(Reconnector, "_give_up", lambda real: _giving_up(real, record))
        wrap(Session, "run", lambda real: _session_running(real, record))
        wrap(Owners, "lose", lambda real: _losing(real, record))
        wrap(Owners, "own", lambda real: _owning(real, record))
        wrap(WireServer, "__init__", lambda real: _opening_hub(real, on_hub))
        wrap(Session, "_handle", lambda real: _handling(real, on_message))
        if record.scenario.server.store is not None:
            wrap(GoalSubscription, "next_frames", lambda real: _telling(real, record))
            wrap(Session, "_say", lambda real: _answering(real, record))
        wrap(FeedbackLog, "_has_room_within", lambda real: _holding(real, on_hold))
        yield


def _accepting(real: Any, record: Record) -> Any:
    def accept(self: GoalRegistry, goal: GoalRecord) -> None:
        real(self, goal)
        life = record.life_of(self)
        record.accepted(life, goal.goal_id, goal.stamp, str(goal.sender))
        life.goals[goal.goal_id, goal.stamp].goal = goal

    return accept


def _restoring(real: Any, record: Record) -> Any:
    def restore(self: GoalRegistry, stored: StoredGoal, **keywords: Any) -> GoalRecord:
        goal: GoalRecord = real(self, stored, **keywords)
        record.restored(record.life_of(self), goal)
        return goal

    return restore


def _truth(record: Record, goal: GoalRecord) -> Truth:
    return next(truth for truth in record.truths(goal.goal_id, goal.stamp) if truth.goal is goal)


def _executing(real: Any, record: Record) -> Any:
    def execute(self: GoalRegistry, goal: GoalRecord) -> None:
        real(self, goal)
        record.changed(_truth(record, goal), goal.status)

    return execute


def _finishing(real: Any, record: Record) -> Any:
    def finish(self: GoalRegistry, goal: GoalRecord, outcome: Outcome[bytes], **when: Any) -> None:
        real(self, goal, outcome, **when)
        truth = _truth(record, goal)
        record.changed(truth, goal.status)
        record.ended(truth, outcome, goal.feedback_count)

    return finish


def _canceling(real: Any, record: Record) -> Any:
    def accept(self: Cancellation, goal: GoalRecord) -> bool:
        accepted: bool = real(self, goal)
        record.changed(_truth(record, goal), goal.status)
        return accepted

    return accept


def _attempting(real: Any, record: Record) -> Any:
    async def _attempt(self: RemoteConnection) -> ActionError:
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

    return _attempt


def _is_lines_fault(error: ProtocolError, record: Record) -> bool:
    """Return whether the error may be caused by a frozen line, and not by a wrong message."""
    what, scenario = str(error), record.scenario
    is_late = "has not said hello" in what
    is_much = "asks for more than it reads" in what and scenario.server.queue < 10_000
    return scenario.climate != "calm" and (is_late or is_much)


def _beginning(real: Any, record: Record) -> Any:
    def _begin(self: RemoteConnection, welcome: Any) -> None:
        state = record.clients[_name_in(self._url)]
        state.is_ready = state.was_ready = True
        state.has_failed, state.lost_at = False, math.inf
        real(self, welcome)

    return _begin


def _giving_up(real: Any, record: Record) -> Any:
    def _give_up(self: Reconnector, error: ActionError) -> None:
        state = record.clients[_name_in(self._url)]
        if state.is_absent(record.now()):  # else it is too early, and no excuse
            state.absent_at = record.now()
        real(self, error)

    return _give_up


def _session_running(real: Any, record: Record) -> Any:
    async def run(self: Session) -> ActionError:
        peer = self._link.peer
        error: ActionError = await real(self)
        record.tell(f"the server's connection with {peer} ended: {error}")
        is_hostile = peer.startswith("hostile-")
        if isinstance(error, ProtocolError) and not (is_hostile or _is_lines_fault(error, record)):
            record.fail("error", f"the server's connection with {peer} ended: {error}")
        return error

    return run


def _losing(real: Any, record: Record) -> Any:
    def lose(self: Owners, held: HeldGoals, *, left: bool) -> None:
        for call in held.calls.values():
            if call.own:
                record.orphaned(GoalID(call.goal_id))
        real(self, held, left=left)

    return lose


def _owning(real: Any, record: Record) -> Any:
    def own(self: Owners, call: GoalSubscription, stream: GoalStream, *rest: Any) -> bool:
        is_own: bool = real(self, call, stream, *rest)
        if is_own:
            record.owned(stream.goal_id)
        return is_own

    return own


def _opening_hub(real: Any, on_hub: Callable[[WireServer], None]) -> Any:
    def __init__(self: WireServer, *args: Any, **keywords: Any) -> None:
        real(self, *args, **keywords)
        on_hub(self)

    return __init__


def _handling(real: Any, on_message: Callable[[Session], None]) -> Any:
    def _handle(self: Session, frame: bytes) -> None:
        real(self, frame)
        on_message(self)

    return _handle


def _holding(real: Any, on_hold: Callable[[FeedbackLog[Any]], None]) -> Any:
    async def has_room_within(self: FeedbackLog[Any], seconds: float) -> bool:
        on_hold(self)
        found: bool = await real(self, seconds)
        return found

    return has_room_within


def _telling(real: Any, record: Record) -> Any:
    def next_frames(self: GoalSubscription) -> list[bytes]:
        frames: list[bytes] = real(self)
        if self.stream is None or not isinstance(self.endpoint, ActionServer):
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

    return next_frames


def _answering(real: Any, record: Record) -> Any:
    async def _say(self: Session, answer: Answer) -> None:
        (server,) = self._handlers._endpoints.values()
        assert isinstance(server, ActionServer)
        life = record.life_of(server._dispatcher)
        if isinstance(answer, GoalChanged):
            record.keeping.told(life, GoalID(answer.goal_id), answer.stamp, answer.status)
        elif isinstance(answer, CancelAnswered):
            for goal_id, stamp, status in answer.goals:
                record.keeping.told(life, GoalID(goal_id), stamp, status)
        await real(self, answer)

    return _say


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
