"""Decisions on goals: `Admission` calls `on_goal`, and carries out its answers.

Theory of operation
-------------------

A goal that is sent goes through `offer`. The registry says whether it is new, the same goal sent
again, or another goal with the same ID. A new goal is decoded, `on_goal` is called, and the goal is
accepted or rejected; if the call is canceled before that, the goal is withdrawn. Only an async
`on_goal` has to be waited for. So `offer` returns the goal's stream itself if it can, and otherwise
a coroutine: the server half of a transport then starts no task for most goals, and serves short
goals over TCP 1.2 times as fast.

A goal that is sent again while it is being decided waits for the decision (`decided`), and so does
a cancel with its ID: `_decisions` has a notifier per undecided goal that a task waits for.

With a store, an acceptance is written before the goal is accepted and anything is told. Until then
the goal counts as undecided; its place in the schedule is taken already. If the call is canceled
meanwhile, the goal is accepted anyway. `_writing` has the offers that are being written. If
another server turns out to have the goal (`lose`), the call is told so.

A new goal is rejected as *busy*, and may be sent again later or elsewhere, if the server drains,
unless an active goal that the drain waits for is its parent; if an operator has paused the action,
and chosen that (`IntakeRule`); if `max_goals` are active (20,000 by
default); if goals and feedback take more than `max_bytes` (256 MiB), or the unread results of its
client more than half of them; if it can neither run nor wait by the schedule (`Scheduler.offer`);
or if the store is full (`StoreFull`).
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Coroutine, Sequence
from contextvars import copy_context
from typing import Any, Generic

from fibaction._runtime.log import clean_logger
from fibaction._runtime.notify import Notifier
from fibaction._runtime.text import excerpt, shortened
from fibaction.border.goal_store import StoreFull
from fibaction.feeds.feedback_log import FeedbackCursor
from fibaction.schema.goal_check import GoalCheck
from fibaction.server.admission.callbacks import SERVER_STOPPING, GoalCallbacks
from fibaction.server.durability.keeper import (
    GOAL_IS_TAKEN,
    STORE_FAILED,
    STORE_IS_LATE,
    Keeper,
)
from fibaction.server.execution.runs import Runs
from fibaction.server.goal_logs import GoalLogs
from fibaction.server.life import Effect, Event
from fibaction.server.registry.goal_record import AnyOffer, GoalRecord, Offer
from fibaction.server.registry.registry import GoalRegistry, Verdict
from fibaction.server.scheduling.dispatcher import Dispatcher
from fibaction.server.scheduling.scheduled_goals import Busy
from fibaction.server.watchers import Watchers
from fibaction.types.action import Action, FeedbackT, GoalT, ResultT
from fibaction.words.errors import (
    ConnectionLost,
    GoalKept,
    GoalRejected,
    ProtocolError,
    RejectionCode,
    StoreError,
)
from fibaction.words.goals import GoalID, current_goal
from fibaction.words.meta import NO_META, parent_in

DRAINING = "busy: the server drains"
WITHDRAWN = "the call was canceled before the decision"

# Looked up for each goal: a name of this module is found faster than a member of an enum.
ACCEPT = Event.ACCEPT

logger = clean_logger("fibaction.server")


class Admission(Generic[GoalT, FeedbackT, ResultT]):
    """The decisions on a server's goals, from arrival to start."""

    def __init__(
        self,
        action: Action[GoalT, FeedbackT, ResultT],
        registry: GoalRegistry,
        runs: Runs[GoalT, FeedbackT, ResultT],
        logs: GoalLogs,
        keeper: Keeper,
        dispatcher: Dispatcher[GoalT],
        watchers: Watchers,
        callbacks: GoalCallbacks[GoalT],
    ) -> None:
        self._action = action
        self._registry = registry
        self._runs = runs
        self._logs = logs
        self._dispatcher = dispatcher
        self._keeper = keeper
        self._watchers = watchers
        self._callbacks = callbacks
        self._check = GoalCheck(action.goal.schema)
        self._decisions: dict[GoalID, Notifier] = {}
        self._writing: dict[GoalID, Offer[GoalT]] = {}  # those that the store does not have yet
        self._drained: Sequence[GoalRegistry] = ()  # those of the servers that drain together
        self._is_closed = False
        self._life = keeper.life
        keeper.life.carry_out(
            {
                Effect.TELL_ACCEPTED: self._tell_accepted,
                Effect.TELL_TOO_LARGE: self._tell_too_large,
                Effect.WITHDRAW: self._withdraw_taken,
            }
        )

    def close(self) -> None:
        """Reject all goals from now on, and all that are still undecided."""
        self._is_closed = True

    def drain(self, together: Sequence[GoalRegistry]) -> None:
        """Reject new goals from now on as busy, but for those that an active goal of this server,
        or in one of the other registries, has sent.
        """
        self._drained = (self._registry, *together)

    def end_drain(self) -> None:
        """Take new goals again."""
        self._drained = ()

    def _is_drained(self, offer: Offer[GoalT]) -> bool:
        """Return whether a new goal is rejected while the server drains."""
        sender = _sender_of(offer)
        return sender is None or not any(one.is_active(sender) for one in self._drained)

    # Goals

    def offer(self, offer: Offer[GoalT]) -> FeedbackCursor | Coroutine[Any, Any, FeedbackCursor]:
        """Decide on a goal: return its stream, or a coroutine that waits for the decision.

        Raises:
            GoalRejected: The goal is rejected at once.
            GoalKept: The store has failed.
        """
        sent = offer.sent
        goal_id = sent.goal_id
        self._keeper.check()
        verdict = self._registry.admit(goal_id, sent.goal, now=self._logs.now())
        if verdict is Verdict.WAIT:
            return self._offer_again(offer)
        if verdict is Verdict.REPEAT:
            return self._logs.follow_again(goal_id, feedback=sent.feedback, sender=sent.sender)
        if self._is_closed:  # a goal that is known gets the same answer as before
            self._registry.withdraw(goal_id)
            raise GoalRejected(SERVER_STOPPING, goal_id=goal_id, code=RejectionCode.STOPPING)
        offer.context = self._watchers.offered(
            goal_id, sent.goal, sent.sender, offer.meta or NO_META
        )
        try:
            self._check_capacity(offer)
            asking = self._decode(offer)
            if asking is None and self._callbacks.are_goals_decided:
                asking = self._ask(offer)
            if asking is None:
                self._accept(offer)
        except GoalRejected as exc:
            raise self._reject(goal_id, exc.reason, exc.code) from None
        except BaseException:
            self._withdraw(goal_id, WITHDRAWN)
            raise
        return self._decide(offer, asking) if offer.stream is None else offer.stream

    def _check_capacity(self, offer: Offer[GoalT]) -> None:
        """Reject a new goal if the server or the client is at a limit, or the server drains."""
        busy = DRAINING if self._drained and self._is_drained(offer) else self._registry.busy
        if not busy and self._registry.budget.used > self._registry.budget.limit:
            while self._logs.expire(self._logs.now()):
                pass
            busy = self._registry.busy
        if not busy and self._registry.results.unread_size:
            busy = self._registry.results.busy_for(offer.sent.sender.owner)
        if busy:
            raise Busy(busy)

    async def _offer_again(self, offer: Offer[GoalT]) -> FeedbackCursor:
        await self.decided(offer.sent.goal_id)
        offered = self.offer(offer)
        return offered if isinstance(offered, FeedbackCursor) else await offered

    async def _decide(self, offer: Offer[GoalT], asking: Awaitable[None] | None) -> FeedbackCursor:
        """Accept a goal after what has to be waited for, and wait until the acceptance is kept."""
        if asking is not None:
            try:
                await asking
                self._accept(offer)
            except GoalRejected as exc:
                raise self._reject(offer.sent.goal_id, exc.reason, exc.code) from None
            except BaseException:
                self._withdraw(offer.sent.goal_id, WITHDRAWN)
                raise
        return await self._kept(offer) if offer.stream is None else offer.stream

    def _decode(self, offer: Offer[GoalT]) -> Coroutine[Any, Any, None] | None:
        """Decode and check a goal; return a coroutine if the check takes time.

        Raises:
            GoalRejected: The goal is not of its type, here or in the coroutine.
        """
        sent = offer.sent
        try:
            offer.request = self._action.goal.decode(sent.goal)
        except ProtocolError as exc:
            return self._check.check(sent.goal, str(exc))
        if sent.checked:
            return None
        checking = self._check.check(sent.goal)
        return None if checking is None else self._ask_later(offer, checking)

    async def _ask_later(self, offer: Offer[GoalT], checking: Awaitable[None]) -> None:
        await checking
        if self._callbacks.are_goals_decided:
            asking = self._ask(offer)
            if asking is not None:
                await asking

    def _ask(self, offer: Offer[GoalT]) -> Coroutine[Any, Any, None] | None:
        sent = offer.sent
        return self._callbacks.ask_goal(offer.request, sent.sender, sent.goal_id, offer.context)

    def _accept(self, offer: Offer[GoalT]) -> None:
        """Accept a goal: with a store, its acceptance is written, and it has no stream before."""
        if self._is_closed:
            raise GoalRejected(SERVER_STOPPING, code=RejectionCode.STOPPING)
        if self._drained and self._is_drained(offer):
            raise Busy(DRAINING)
        if self._registry.intake.busy:
            raise Busy(self._registry.intake.busy)
        sent = offer.sent
        goal_id, sender = sent.goal_id, sent.sender
        has_turn = self._dispatcher.offer(goal_id, offer.request, sender, sent.deadline)
        is_held = self._runs.suspects.goals or self._registry.intake.holds
        offer.is_running = has_turn and not is_held
        if self._runs.suspects.goals:
            self._runs.suspects.note_sent(goal_id, _sender_of(offer))
        offer.goal = self._registry.prepare(
            goal_id, stamp=time.time_ns(), sender=sender, deadline=sent.deadline
        )
        offer.goal.clock = offer.goal.stamp - time.monotonic_ns()
        if offer.meta:
            offer.goal.take_origin(offer.meta)
        if offer.context is None:
            offer.context = copy_context()  # that of this call
        self._writing[goal_id] = offer
        self._life.step(offer, ACCEPT)

    def _tell_accepted(self, offer: Offer[GoalT]) -> None:
        """Begin the life of a goal whose acceptance is kept."""
        sent = offer.sent
        goal_id = sent.goal_id
        del self._writing[goal_id]
        self._registry.accept(offer.goal)
        log = self._runs.add(offer.goal, offer.request, sent.goal, context=offer.context)
        offer.stream = log.follow(feedback=sent.feedback, own=True)
        if offer.is_left:
            offer.stream.close()
        if self._decisions:
            self._tell_decision(goal_id)
        self._dispatcher.accepted(goal_id)

    # Acceptance with a store

    def _tell_too_large(self, offer: Offer[GoalT]) -> None:
        goal_id = offer.sent.goal_id
        del self._writing[goal_id]
        error = offer.too_large
        if isinstance(error, StoreFull):
            offer.error = self._reject(goal_id, f"busy: {error}", RejectionCode.BUSY)
        else:
            reason = f"the goal cannot be kept: {error}"
            offer.error = self._reject(goal_id, reason, RejectionCode.INVALID)
        self._dispatcher.withdraw(goal_id)

    async def _kept(self, offer: Offer[GoalT]) -> FeedbackCursor:
        """Wait until the acceptance of a goal is kept, and return its stream."""
        try:
            await self._keeper.kept(offer.write)
        except StoreError as exc:
            has_failed = self._keeper.failure is not None
            raise GoalKept(STORE_FAILED if has_failed else STORE_IS_LATE) from exc
        except BaseException:
            offer.leave(self._logs.now())
            raise
        if offer.error is not None:
            raise offer.error
        if offer.stream is not None:
            return offer.stream
        sent = offer.sent
        if self._registry.is_active(sent.goal_id):  # it has come here from the store meanwhile
            return self._logs.follow_again(sent.goal_id, feedback=sent.feedback, sender=sent.sender)
        raise ConnectionLost(GOAL_IS_TAKEN)

    def writing(self, goal_id: GoalID) -> GoalRecord | None:
        """Return the record of a goal whose acceptance is being written."""
        offer = self._writing.get(goal_id)
        return None if offer is None else offer.goal

    def lose(self, goal: GoalRecord | None) -> bool:
        """Let go of a goal that another server has; return whether it was being written here."""
        offer = None if goal is None else self._writing.get(goal.goal_id)
        if offer is None or offer.goal is not goal:
            return False
        self._life.step(offer, Event.LOSE)
        return True

    def _withdraw_taken(self, offer: Offer[GoalT]) -> None:
        goal_id = offer.sent.goal_id
        logger.info("goal %s of action %r: another server has it", goal_id, self._action.name)
        del self._writing[goal_id]
        self._withdraw(goal_id, GOAL_IS_TAKEN)
        self._dispatcher.withdraw(goal_id)

    def _reject(self, goal_id: GoalID, reason: str, code: RejectionCode) -> GoalRejected:
        """Reject a goal, and return the error to raise. A retry gets the same one, but for a goal
        that may be accepted later: it is decided again.
        """
        reason = shortened(reason)
        if code.is_temporary:
            self._registry.withdraw(goal_id)
            error = GoalRejected(reason, goal_id=goal_id, code=code)
        else:
            error = self._registry.reject(goal_id, reason, code, now=self._logs.now())
        self._tell_decision(goal_id)
        name = self._action.name
        logger.info("goal %s of action %r: rejected: %s", goal_id, name, excerpt(reason))
        self._watchers.rejected(goal_id, reason)
        return error

    def _withdraw(self, goal_id: GoalID, reason: str) -> None:
        """Forget a goal that is not decided; a retry is decided again."""
        self._registry.withdraw(goal_id)
        self._tell_decision(goal_id)
        self._watchers.rejected(goal_id, reason)

    def wake(self) -> None:
        """Wake all that wait for decisions: the store answers no more."""
        for goal_id in tuple(self._decisions):
            self._tell_decision(goal_id)

    async def decided(self, goal_id: GoalID) -> None:
        """Wait until the goal is decided; return at once if it is not undecided.

        Raises:
            GoalKept: The store has failed, or has not answered before the server has stopped.
        """
        while self._registry.is_undecided(goal_id):
            self._keeper.check()
            self._callbacks.check_not_deciding(goal_id)
            await self._decisions.setdefault(goal_id, Notifier()).wait()

    def _tell_decision(self, goal_id: GoalID) -> None:
        decision = self._decisions.pop(goal_id, None)
        if decision is not None:
            decision.notify()


def _sender_of(offer: AnyOffer) -> GoalID | None:
    """Return the goal whose executor has sent a goal: its parent, or, without one, the goal that
    runs in this task, as it does for a client in this process.
    """
    if (parent := parent_in(offer.meta)) is not None:
        return parent.goal_id
    current = current_goal.get()
    return None if current is None else current.goal_id
