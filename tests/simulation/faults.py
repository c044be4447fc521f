"""Small deliberate mistakes in the product, to show that the simulation finds such.

Each is a context manager that replaces one method of one class, or one function of one module, as a
slip in its code would, and has seeds of scenarios that find it. Any invariant may find it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import wraps
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
from fibaction.wire.link import PING, Link
from fibaction.wire.messages import CancelAnswered, Ended, Follow, Received, decode_from_client
from fibaction.wire.server.ownership import Owners
from fibaction.wire.server.session import Session
from fibaction.wire.server.subscriptions import WireSubscription
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


Make = Callable[[Any], Any]
Wrong = Callable[..., Any]


def making(cls: type | ModuleType, method: str, *seeds: int) -> Callable[[Make], Make]:
    """Register a function that makes the wrong method, with a state of its own, from the real one;
    its docstring describes the mistake.
    """

    def register(make: Make) -> Make:
        name = make.__name__.replace("_", " ")
        meaning = " ".join((make.__doc__ or "").split())
        MISTAKES[name] = Mistake(name, meaning, cls, method, make, seeds)
        return make

    return register


def mistake(cls: type | ModuleType, method: str, *seeds: int) -> Callable[[Wrong], Wrong]:
    """Register a wrong method, which takes the real one before its own arguments."""

    def register(wrong: Wrong) -> Wrong:
        @wraps(wrong)
        def make(real: Any) -> Wrong:
            return lambda *args, **keywords: wrong(real, *args, **keywords)

        making(cls, method, *seeds)(make)
        return wrong

    return register


class _Deaf(Notifier):
    """A notifier that wakes no task."""

    __slots__ = ()

    def notify(self) -> None:
        pass


# The server


@mistake(GoalRegistry, "admit", 38, 10, 28)
def a_goal_runs_again_when_it_is_sent_again(
    real: Any, self: GoalRegistry, goal_id: GoalID, payload: bytes, *, now: float
) -> Any:
    """Treat a retry as a new goal."""
    verdict: Verdict = real(self, goal_id, payload, now=now)
    if verdict is Verdict.REPEAT:
        self._undecided[goal_id] = _Undecided(
            digest_of(payload), HeldBytes(self.budget, len(payload))
        )
        return Verdict.DECIDE
    return verdict


@mistake(Cancellation, "accept", 192, 94, 376)
def a_cancel_races_the_end(real: Any, self: Cancellation, goal: GoalRecord) -> Any:
    """Report a goal as canceling that has ended while its cancel was decided."""
    if goal.status.is_terminal:
        self._canceling[goal.goal_id] = goal.info
        return True
    return real(self, goal)


@mistake(GoalRegistry, "outcome_for", 18, 36, 47)
def a_cancel_beats_the_result(
    real: Any, self: GoalRegistry, goal: GoalRecord, ending: Ending, *, stamp: int
) -> Any:
    """End a goal as canceled that yields its result while it is canceling."""
    if goal.status is GoalStatus.CANCELING and ending.kind is EndKind.RESULT:
        ending = Ending(EndKind.CANCELED, ending.result)
    return real(self, goal, ending, stamp=stamp)


@mistake(ExpiringMap, "put", 159, 97, 190)
def a_result_expires_too_early(
    real: Any, self: ExpiringMap[Any], goal_id: GoalID, thing: Any, now: float, **keywords: Any
) -> Any:
    """Keep outcomes for half the time."""
    real(self, goal_id, thing, now - self._seconds / 2, **keywords)


@mistake(Admission, "_tell_decision", 97)
def a_decision_is_not_told(_real: Any, self: Admission[Any, Any, Any], goal_id: GoalID) -> Any:
    """Do not wake tasks that wait for the decision on a goal."""


@mistake(FeedbackWindow, "append", 6)
def feedback_is_numbered_twice(real: Any, self: FeedbackWindow[Any], payload: bytes) -> Any:
    """Give every fifth message the number of the one before."""
    if self.goal.feedback_count % 5 == 4:
        self.goal.feedback_count -= 1
    real(self, payload)


@mistake(FeedbackLog, "finish", 8, 19)
def the_end_wakes_only_readers(real: Any, self: FeedbackLog[Any]) -> Any:
    """Do not notify followers without feedback that the goal has ended."""
    for stream in self._readers:
        stream.news.notify()


@mistake(FeedbackCursor, "take", 14, 5, 26)
def the_end_overtakes_feedback(real: Any, self: FeedbackCursor, limit: int = 1) -> Any:
    """Drop the unread feedback of a goal when it ends."""
    outcome = self.known_outcome()
    return real(self, limit) if outcome is None else (outcome,)


@making(StatusBroadcast, "publish", 5, 6, 8)
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
async def an_answer_is_dropped(real: Any, self: Session, answer: Any) -> Any:
    """Do not send the answer to a cancel."""
    if not isinstance(answer, CancelAnswered):
        await real(self, answer)


@mistake(Session, "_handle", 5, 8, 14)
def received_is_not_heard(real: Any, self: Session, frame: bytes) -> Any:
    """Ignore that a client has received the end of a goal."""
    if not isinstance(decode_from_client(frame), Received):
        real(self, frame)


@mistake(Owners, "_wait", 49, 3, 66)
async def an_orphan_is_never_ended(real: Any, self: Owners, *_: Any) -> Any:
    """Keep the goals of a client that does not come back for ever."""


@mistake(WireSubscription, "add", 30, 14, 8)
def credit_counts_twice(real: Any, self: WireSubscription, count: int) -> Any:
    """Send a client more than its credit allows."""
    real(self, 2 * count)


@making(Notifier, "notify", 28, 22)
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
def the_resume_number_is_one_too_large(real: Any, self: RemoteGoal) -> Any:
    """Resume a goal on a new connection one message too late."""
    message = real(self)
    if isinstance(message, Follow) and message.after is not None:
        message.after += 1
    return message


@mistake(RemoteGoal, "opening", 17, 50)
def the_resume_number_is_one_too_small(real: Any, self: RemoteGoal) -> Any:
    """Resume a goal on a new connection with messages that have arrived already."""
    message = real(self)
    if isinstance(message, Follow) and message.after:
        message.after -= 1
    return message


@mistake(RemoteGoal, "on_message", 8)
def the_end_wakes_nobody(real: Any, self: RemoteGoal, message: Any) -> Any:
    """Do not wake tasks of the client that wait for the end of a goal."""
    news = self.news
    if isinstance(message, Ended):
        self.news = _Deaf()
    try:
        return real(self, message)
    finally:
        self.news = news


@mistake(Credits, "grant", 22, 14)
def credit_is_never_granted(real: Any, self: Credits, count: int = 1) -> Any:
    """Give no credit for messages that were read."""


@mistake(RemoteConnection, "_begin", 5, 6)
def a_call_is_not_opened_again(real: Any, self: RemoteConnection, welcome: Any) -> Any:
    """Do not resume the last request on a new connection."""
    if self.calls._calls:
        self.calls._calls.popitem()
    real(self, welcome)


@mistake(OpenCalls, "fail", 2, 3)
def giving_up_forgets_a_waiter(real: Any, self: OpenCalls, error: Any, absent: Any) -> Any:
    """Do not fail one waiting call when a connection is given up."""
    if self._calls:
        self._calls.popitem()
    real(self, error, absent)


@mistake(Reconnector, "_lose_patience", 2, 4)
async def patience_ends_too_early(real: Any, self: Reconnector, patience: Any, ends: float) -> Any:
    """Give up a lost connection after half of the timeout."""
    await real(self, patience, (ends + current_time()) / 2)


@mistake(_Merger, "_follow", 400, 291)
async def a_goal_is_followed_twice(
    real: Any, self: _Merger[Any], goal_id: GoalID, *args: Any
) -> Any:
    """Follow a goal a second time if its status changes after the end of its feedback."""
    await real(self, goal_id, *args)
    self._late.pop(goal_id, None)


# Both halves


@mistake(Link, "_watch", 31, 9, 17)
async def silence_is_not_noticed(real: Any, self: Link) -> Any:
    """Treat a silent connection as alive."""
    while True:
        await sleep(self.heartbeat.interval)
        self.post(PING)


@mistake(StreamChannel, "aclose", 1, 2, 0)
async def a_connection_is_left_open(real: Any, self: StreamChannel) -> Any:
    """Do not close a connection after its end."""
