"""`Watchers`: what a server tells its watchers, none of which can harm a goal.

Watchers are told of feedback, and of a goal's statuses, by its `WatchedLog`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextvars import Context, copy_context
from inspect import iscoroutinefunction
from time import perf_counter
from typing import Any, TypeAlias

from fibaction._runtime.log import clean_logger
from fibaction.border.abc import FeedbackItem
from fibaction.border.byte_budgets import ByteBudget
from fibaction.border.watchers import Watcher
from fibaction.feeds.feedback_log import FeedbackLog
from fibaction.server.registry.goal_record import GoalRecord
from fibaction.types.action import ActionInfo
from fibaction.words.errors import FAILURES, text_of
from fibaction.words.goals import CancelAnswer, GoalID, Sender
from fibaction.words.meta import Meta

SLOW = 0.1
"""Seconds of one call of a watcher after which the log names it: everything else waits for it."""

METHODS = tuple(name for name in vars(Watcher) if not name.startswith("_"))

_Calls: TypeAlias = tuple[tuple[Watcher, Callable[..., None]], ...]

logger = clean_logger("fibaction.server")


class Watchers:
    """The watchers of one server, called one after another. Most servers have none."""

    def __init__(self, action: str, watchers: Iterable[Watcher]) -> None:
        """Call these watchers with the name of the action.

        Raises:
            TypeError: One of them is not a `Watcher`, or has an async method.
        """
        self._action = action
        self.members = tuple(watchers)
        """The watchers."""
        for watcher in self.members:
            _check(watcher)
        self._calls = {name: self._calls_of(name) for name in METHODS}
        self._feedback = self._calls["feedback"]
        self._failed: set[Watcher] = set()
        self._slow: set[Watcher] = set()

    def _calls_of(self, name: str) -> _Calls:
        """Return the methods of that name that do anything."""
        nothing = getattr(Watcher, name)
        return tuple(
            (one, getattr(one, name))
            for one in self.members
            if getattr(type(one), name) is not nothing
        )

    def opened(self, info: ActionInfo) -> None:
        """Tell that the server starts."""
        self._call("opened", info)

    def offered(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> Context | None:
        """Tell that a goal was offered, and return the context for its executor; None for that of
        the call that accepts it.
        """
        if not self.members:
            return None
        context = copy_context()
        context.run(self._call, "offered", self._action, goal_id, goal, sender, meta)
        return context

    def taken_over(self, goal_id: GoalID, goal: bytes, sender: Sender, meta: Meta) -> Context:
        """Tell that a goal comes from the store, and return the context for its executor."""
        context = copy_context()
        context.run(self._call, "taken_over", self._action, goal_id, goal, sender, meta)
        return context

    def rejected(self, goal_id: GoalID, reason: str) -> None:
        """Tell that a goal was rejected."""
        self._call("rejected", self._action, goal_id, reason)

    def accepted(
        self, goal: GoalRecord, window: int, latest: bool, budget: ByteBudget, payload: bytes
    ) -> FeedbackLog[GoalRecord]:
        """Tell that a goal was accepted, and return its log, which tells what follows."""
        if not self.members:
            return FeedbackLog(goal, window, latest, budget, payload)
        self._call("accepted", self._action, goal.info, payload)
        return WatchedLog(self, goal, window, latest, budget, payload)

    def changed(self, goal: GoalRecord) -> None:
        """Tell that the status of a goal has changed, or that the goal has ended."""
        if goal.outcome is None:
            self._call("changed", self._action, goal.info)
        else:
            self._call("ended", self._action, goal.info, goal.outcome)

    def feedback(self, goal_id: GoalID, item: FeedbackItem) -> None:
        """Tell a feedback message."""
        self._call_all("feedback", self._feedback, self._action, goal_id, item)

    def missed(self, goal_id: GoalID, count: int) -> None:
        """Tell that a follower has missed feedback."""
        self._call("missed", self._action, goal_id, count)

    def canceled(self, goal_id: GoalID | None, answer: CancelAnswer) -> None:
        """Tell the answer to a cancel."""
        self._call("canceled", self._action, goal_id, answer)

    def left(self, goal: GoalRecord, reason: str) -> None:
        """Tell that a goal is the server's no longer."""
        self._call("left", self._action, goal.info, reason)

    def closed(self, info: ActionInfo) -> None:
        """Tell that the server has stopped."""
        self._call("closed", info)

    def _call(self, name: str, *arguments: Any) -> None:
        self._call_all(name, self._calls[name], *arguments)

    def _call_all(self, name: str, calls: _Calls, *arguments: Any) -> None:
        begin = perf_counter()
        for watcher, call in calls:
            try:
                call(*arguments)
            except FAILURES as exc:
                self._report(watcher, name, exc)
            before, begin = begin, perf_counter()
            if (seconds := begin - before) > SLOW and watcher not in self._slow:
                self._slow.add(watcher)
                logger.warning(
                    "action %r: %s.%s took %.1f s, while everything else waited; later slow calls"
                    " of it are not logged",
                    self._action,
                    type(watcher).__qualname__,
                    name,
                    seconds,
                )

    def _report(self, watcher: Watcher, name: str, exc: Exception | SystemExit) -> None:
        if watcher in self._failed:
            return
        self._failed.add(watcher)
        logger.error(
            "action %r: %s.%s failed, and goals continue; later errors of it are not logged: %s",
            self._action,
            type(watcher).__qualname__,
            name,
            text_of(exc),
            exc_info=exc,
        )


class WatchedLog(FeedbackLog[GoalRecord]):
    """The log of a goal of a server with watchers. Logs of other servers do not pay for them."""

    __slots__ = ("_watchers",)

    def __init__(
        self,
        watchers: Watchers,
        goal: GoalRecord,
        window: int,
        latest: bool,
        budget: ByteBudget,
        payload: bytes,
    ) -> None:
        super().__init__(goal, window, latest, budget, payload)
        self._watchers = watchers

    def tell_status(self) -> None:
        super().tell_status()
        if len(self.statuses) > 1:  # the first one is told as the acceptance
            self._watchers.changed(self.goal)

    def append(self, payload: bytes) -> bool:
        is_full = super().append(payload)
        self._watchers.feedback(self.goal.goal_id, self._items[-1])
        return is_full

    def note_dropped(self, count: int) -> None:
        self._watchers.missed(self.goal.goal_id, count)


def _check(watcher: object) -> None:
    if not isinstance(watcher, Watcher):
        raise TypeError(f"watchers are objects of classes derived from Watcher, not {watcher!r}")
    for name in METHODS:
        if iscoroutinefunction(getattr(watcher, name)):
            raise TypeError(
                f"{type(watcher).__qualname__}.{name} is async, and the server does not wait for"
                f" watchers: write it with `def`"
            )
