"""Small deliberate mistakes in the product, to show that the simulation finds such.

Each is a context manager that replaces one method of one class, or one function of one module, as a
slip in its code would, and has seeds of scenarios that find it. Any invariant may find it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import msgspec
from anyio import current_time, sleep

from fibaction._runtime.notify import Notifier
from fibaction.client.events import _Merger
from fibaction.feeds.feedback_log import FeedbackCursor, FeedbackLog
from fibaction.feeds.feedback_window import FeedbackWindow
from fibaction.feeds.status_broadcast import StatusBroadcast
from fibaction.server.admission.admission import Admission
from fibaction.server.registry.cancellation import Cancellation
from fibaction.server.registry.goal_record import Ending, EndKind, GoalRecord
from fibaction.server.registry.kept_results import ExpiringMap, HeldBytes
from fibaction.server.registry.registry import GoalRegistry, Verdict, _Undecided
from fibaction.wire.channel import StreamChannel
from fibaction.wire.client.calls import Credits
from fibaction.wire.client.connection import RemoteConnection
from fibaction.wire.client.open_calls import OpenCalls
from fibaction.wire.client.reconnect import Reconnector
from fibaction.wire.client.remote_goal import RemoteGoal
from fibaction.wire.codec import decode_from_client
from fibaction.wire.link import PING, Link
from fibaction.wire.messages import CancelAnswered, Ended, Follow, Received
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.session import Session
from fibaction.wire.server.subscriptions import Subscription
from fibaction.words.goals import GoalID, GoalInfo, digest_of
from fibaction.words.statuses import GoalStatus


class Mistake(msgspec.Struct, frozen=True):
    """A deliberate mistake."""

    name: str
    meaning: str
    cls: type | ModuleType
    method: str
    make: Callable[[Any], Any]
    """The function that makes the wrong method from the real one."""
    seeds: tuple[int, ...]
    """The seeds of scenarios that are known to find it, tried first."""

    @contextmanager
    def made(self) -> Generator[None, None, None]:
        """Make the mistake for as long as the block lasts."""
        real = self.cls.__dict__[self.method]
        setattr(self.cls, self.method, self.make(real))
        try:
            yield
        finally:
            setattr(self.cls, self.method, real)


MISTAKES: dict[str, Mistake] = {}


def mistake(
    cls: type | ModuleType, method: str, *seeds: int
) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Register a function that makes the wrong method; its docstring describes the mistake."""

    def register(make: Callable[[Any], Any]) -> Callable[[Any], Any]:
        name = make.__name__.replace("_", " ")
        meaning = " ".join((make.__doc__ or "").split())
        MISTAKES[name] = Mistake(name, meaning, cls, method, make, seeds)
        return make

    return register


class _Deaf(Notifier):
    """A notifier that wakes no task."""

    __slots__ = ()

    def notify(self) -> None:
        pass


# The server


@mistake(GoalRegistry, "admit", 38, 10, 28)
def a_goal_runs_again_when_it_is_sent_again(real: Any) -> Any:
    """Treat a retry as a new goal."""

    def admit(self: GoalRegistry, goal_id: GoalID, payload: bytes, *, now: float) -> Verdict:
        verdict: Verdict = real(self, goal_id, payload, now=now)
        if verdict is Verdict.REPEAT:
            self._undecided[goal_id] = _Undecided(
                digest_of(payload), HeldBytes(self.budget, len(payload))
            )
            return Verdict.DECIDE
        return verdict

    return admit


@mistake(Cancellation, "accept", 192, 94, 376)
def a_cancel_races_the_end(real: Any) -> Any:
    """Report a goal as canceling that has ended while its cancel was decided."""

    def accept(self: Cancellation, goal: GoalRecord) -> bool:
        if goal.status.is_terminal:
            self._canceling[goal.goal_id] = goal.info
            return True
        accepted: bool = real(self, goal)
        return accepted

    return accept


@mistake(GoalRegistry, "outcome_for", 18, 36, 47)
def a_cancel_beats_the_result(real: Any) -> Any:
    """End a goal as canceled that yields its result while it is canceling."""

    def outcome_for(self: GoalRegistry, goal: GoalRecord, ending: Ending, *, stamp: int) -> Any:
        if goal.status is GoalStatus.CANCELING and ending.kind is EndKind.RESULT:
            ending = Ending(EndKind.CANCELED, ending.result)
        return real(self, goal, ending, stamp=stamp)

    return outcome_for


@mistake(ExpiringMap, "put", 159, 97, 190)
def a_result_expires_too_early(real: Any) -> Any:
    """Keep outcomes for half the time."""

    def put(
        self: ExpiringMap[Any], goal_id: GoalID, thing: Any, now: float, **keywords: Any
    ) -> None:
        real(self, goal_id, thing, now - self._seconds / 2, **keywords)

    return put


@mistake(Admission, "_tell_decision", 97)
def a_decision_is_not_told(_real: Any) -> Any:
    """Do not wake tasks that wait for the decision on a goal."""

    def _tell_decision(self: Admission[Any, Any, Any], goal_id: GoalID) -> None:
        pass

    return _tell_decision


@mistake(FeedbackWindow, "append", 6)
def feedback_is_numbered_twice(real: Any) -> Any:
    """Give every fifth message the number of the one before."""

    def append(self: FeedbackWindow[Any], payload: bytes) -> None:
        if self.goal.feedback_count % 5 == 4:
            self.goal.feedback_count -= 1
        real(self, payload)

    return append


@mistake(FeedbackLog, "finish", 8, 19)
def the_end_wakes_only_readers(real: Any) -> Any:
    """Do not notify followers without feedback that the goal has ended."""

    def finish(self: FeedbackLog[Any]) -> None:
        for stream in self._readers:
            stream.news.notify()

    return finish


@mistake(FeedbackCursor, "take", 14, 5, 26)
def the_end_overtakes_feedback(real: Any) -> Any:
    """Drop the unread feedback of a goal when it ends."""

    def take(self: FeedbackCursor, limit: int = 1) -> Any:
        outcome = self.known_outcome()
        return real(self, limit) if outcome is None else (outcome,)

    return take


@mistake(StatusBroadcast, "publish", 5, 6, 8)
def statuses_come_out_of_order(real: Any) -> Any:
    """Send the status EXECUTING after the status that follows it."""
    late: list[GoalInfo] = []

    def publish(self: StatusBroadcast, info: GoalInfo) -> int:
        if info.status is GoalStatus.EXECUTING:
            late.append(info)
            return 0
        number: int = real(self, info)
        while late:
            number = real(self, late.pop())
        return number

    return publish


# The server's half of a connection


@mistake(Session, "_say", 5, 17, 8)
def an_answer_is_dropped(real: Any) -> Any:
    """Do not send the answer to a cancel."""

    async def _say(self: Session, answer: Any) -> None:
        if not isinstance(answer, CancelAnswered):
            await real(self, answer)

    return _say


@mistake(Session, "_handle", 5, 8, 14)
def received_is_not_heard(real: Any) -> Any:
    """Ignore that a client has received the end of a goal."""

    def _handle(self: Session, frame: bytes) -> None:
        if not isinstance(decode_from_client(frame), Received):
            real(self, frame)

    return _handle


@mistake(Owners, "_wait", 49, 3, 66)
def an_orphan_is_never_ended(real: Any) -> Any:
    """Keep the goals of a client that does not come back for ever."""

    async def _wait(self: Owners, *_: Any) -> None:
        pass

    return _wait


@mistake(Subscription, "add", 30, 14, 8)
def credit_counts_twice(real: Any) -> Any:
    """Send a client more than its credit allows."""

    def add(self: Subscription, count: int) -> None:
        real(self, 2 * count)

    return add


@mistake(Notifier, "notify", 28, 22)
def a_listener_is_lost(real: Any) -> Any:
    """Forget the callback of a notifier instead of calling it, once in a while."""
    calls = [0]

    def notify(self: Notifier) -> None:
        calls[0] += self.on_next is not None
        if calls[0] % 20 == 19:
            self.on_next = None
        real(self)

    return notify


# The client's half


@mistake(RemoteGoal, "opening", 483, 97, 458)
def the_resume_number_is_one_too_large(real: Any) -> Any:
    """Resume a goal on a new connection one message too late."""

    def opening(self: RemoteGoal) -> Any:
        message = real(self)
        if isinstance(message, Follow) and message.after is not None:
            message.after += 1
        return message

    return opening


@mistake(RemoteGoal, "opening", 17, 50)
def the_resume_number_is_one_too_small(real: Any) -> Any:
    """Resume a goal on a new connection with messages that have arrived already."""

    def opening(self: RemoteGoal) -> Any:
        message = real(self)
        if isinstance(message, Follow) and message.after:
            message.after -= 1
        return message

    return opening


@mistake(RemoteGoal, "on_message", 8)
def the_end_wakes_nobody(real: Any) -> Any:
    """Do not wake tasks of the client that wait for the end of a goal."""

    def hear(self: RemoteGoal, message: Any) -> Any:
        news = self.news
        if isinstance(message, Ended):
            self.news = _Deaf()
        try:
            return real(self, message)
        finally:
            self.news = news

    return hear


@mistake(Credits, "grant", 22, 14)
def credit_is_never_granted(real: Any) -> Any:
    """Give no credit for messages that were read."""

    def grant(self: Credits, count: int = 1) -> None:
        pass

    return grant


@mistake(RemoteConnection, "_begin", 5, 6)
def a_call_is_not_opened_again(real: Any) -> Any:
    """Do not resume the last request on a new connection."""

    def _begin(self: RemoteConnection, welcome: Any) -> None:
        if self.calls._calls:
            self.calls._calls.popitem()
        real(self, welcome)

    return _begin


@mistake(OpenCalls, "fail", 2, 3)
def giving_up_forgets_a_waiter(real: Any) -> Any:
    """Do not fail one waiting call when a connection is given up."""

    def fail(self: OpenCalls, error: Any, absent: Any) -> None:
        if self._calls:
            self._calls.popitem()
        real(self, error, absent)

    return fail


@mistake(Reconnector, "_lose_patience", 2, 4)
def patience_ends_too_early(real: Any) -> Any:
    """Give up a lost connection after half of the timeout."""

    async def _lose_patience(self: Reconnector, patience: Any, ends: float) -> None:
        await real(self, patience, (ends + current_time()) / 2)

    return _lose_patience


@mistake(_Merger, "_follow", 400, 291)
def a_goal_is_followed_twice(real: Any) -> Any:
    """Follow a goal a second time if its status changes after the end of its feedback."""

    async def _follow(self: _Merger[Any], goal_id: GoalID, *args: Any) -> None:
        await real(self, goal_id, *args)
        self._late.pop(goal_id, None)

    return _follow


# Both halves


@mistake(Link, "_watch", 31, 9, 17)
def silence_is_not_noticed(real: Any) -> Any:
    """Treat a silent connection as alive."""

    async def _watch(self: Link) -> None:
        while True:
            await sleep(self.heartbeat.interval)
            self.post(PING)

    return _watch


@mistake(StreamChannel, "aclose", 1, 2, 0)
def a_connection_is_left_open(real: Any) -> Any:
    """Do not close a connection after its end."""

    async def aclose(self: StreamChannel) -> None:
        pass

    return aclose
