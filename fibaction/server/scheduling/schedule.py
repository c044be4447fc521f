"""`Schedule`: the rules by which a server runs its accepted goals."""

from __future__ import annotations

import math
from collections.abc import Hashable
from inspect import iscoroutinefunction
from typing import Any, Literal

from fibaction._runtime.settings_struct import SettingsStruct
from fibaction.server.admission.sender_argument import GoalFunction, with_sender
from fibaction.words.intake import ScheduleInfo, told_count, told_time

WORDS = ("reject", "preempt", "replace")
LONGEST_LIMIT_NAME = 50
"""Characters of the name of a limit."""


class Schedule(SettingsStruct, frozen=True, kw_only=True):
    """The rules by which a server runs its accepted goals. Without one, all run at once.

    One arm that always moves to the newest target, as `SimpleActionServer` of ROS 1 does:

        ActionServer(MOVE, move, schedule=Schedule(concurrency=1, when_full="preempt"))

    Four workers, and a hundred goals that wait, the most urgent first:

        Schedule(concurrency=4, queue=100, priority=lambda goal: goal.urgency)

    A goal that waits is ACCEPTED. A goal that is preempted, replaced or too late ends as ABORTED,
    and the reason says so. If its executor has begun, it is interrupted, even on a server with
    `interrupt_on_cancel=False`. Its place is free when its clean-up has ended.

    Servers that have the same object share its limits, for example two actions of one arm.
    """

    concurrency: int | None = None
    """Executors that run at the same time, for each key; None for any number."""
    queue: int = 0
    """Accepted goals that may wait for a place, for each key."""
    when_full: Literal["reject", "preempt", "replace"] = "reject"
    """The goal that gives way when no place is free to run or to wait: with `reject` the new one,
    with `preempt` the one that has run longest, with `replace` the newest one that waits."""
    key: GoalFunction[Any, Hashable] | None = None
    """A function that returns the key of a goal, for example the arm that it moves; None for one
    key. It may have a second parameter, the `Sender` of the goal."""
    total: int | None = None
    """Executors that run at the same time, for all keys together; None for any number."""
    priority: GoalFunction[Any, float] | None = None
    """A function that returns the urgency of a goal, which may have the `Sender` as its second
    parameter: goals with larger numbers start first, equal ones in the order of their arrival. A
    goal preempts only less urgent ones, and then at once, even if there is room to wait."""
    queue_timeout: float = math.inf
    """Seconds that a goal may wait; then it ends as ABORTED."""
    skip_expired: bool = False
    """True to end a goal as ABORTED if its client's `timeout` is over when its turn comes. A client
    that is there cancels its goal itself at that time; this is for clients that are gone."""
    run_timeout: float = math.inf
    """Seconds that an executor may run; then it is interrupted, and its goal ends as ABORTED. If
    its clean-up takes longer than the server's `shutdown_timeout`, it is killed."""
    handover: float = 0.0
    """Seconds that a goal which is preempted has to take its successor over (`goal.take_over()`),
    before it is interrupted; `math.inf` never to interrupt it."""
    fleet_limit: str = ""
    """The name of a limit that all workers of a fleet have together: with it, `concurrency` counts
    the goals of a key at all workers whose schedules have the same name. Empty for a limit of this
    server alone."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: A limit is not a whole number, a time is not a number, or `key` or `priority`
                is not a function of a goal, or of a goal and its sender, or is async.
            ValueError: A number is out of range, `when_full` is another word, or a rule can never
                apply.
        """
        for name, least in (("concurrency", 1), ("total", 1), ("queue", 0)):
            _check_is_limit(name, getattr(self, name), least)
        if self.when_full not in WORDS:
            raise ValueError(
                f"when_full must be 'reject', 'preempt' or 'replace', not {self.when_full!r}"
            )
        for name in ("key", "priority"):
            function = getattr(self, name)
            if function is not None:
                with_sender(name, function)
                if iscoroutinefunction(function):
                    raise TypeError(
                        f"{name} must be a function without `async`, which does not wait"
                    )
        for name in ("queue_timeout", "run_timeout", "handover"):
            _check_is_time(name, getattr(self, name))
        _check_is("skip_expired", self.skip_expired, bool, "True or False")
        _check_is("fleet_limit", self.fleet_limit, str, "a text")
        self._check_has_effect()
        if self.fleet_limit:
            self._check_holds_in_a_fleet()

    def told(self, max_goals: int) -> ScheduleInfo:
        """Return the limits as they are told to clients, with the one of active goals."""
        return ScheduleInfo(
            max_goals=told_count(max_goals),
            concurrency=told_count(self.concurrency),
            total=told_count(self.total),
            queue=told_count(self.queue) or 0,
            is_keyed=self.key is not None,
            has_priority=self.priority is not None,
            when_full=self.when_full,
            queue_timeout=told_time(self.queue_timeout),
            run_timeout=told_time(self.run_timeout),
            fleet_limit=self.fleet_limit,
        )

    def _check_has_effect(self) -> None:
        if self.concurrency is None and self.total is None:
            for rule, is_set in (
                (f"queue={self.queue}", self.queue),
                (f"when_full={self.when_full!r}", self.when_full != "reject"),
                ("priority", self.priority),
                ("skip_expired=True", self.skip_expired),
            ):
                if is_set:
                    raise ValueError(f"{rule} needs a limit: set concurrency or total, too")
        if self.when_full == "replace" and not self.queue:
            raise ValueError("when_full='replace' needs a queue of at least 1, not 0")
        if self.when_full == "preempt":
            return
        if self.handover:
            raise ValueError(f"handover={self.handover:g} needs when_full='preempt'")
        if self.queue_timeout < math.inf and not self.queue:
            raise ValueError(
                f"queue_timeout={self.queue_timeout:g} needs a queue of at least 1, not 0"
            )
        if self.skip_expired and not self.queue:
            raise ValueError("skip_expired=True needs a queue of at least 1, not 0")

    def _check_holds_in_a_fleet(self) -> None:
        limit = f"fleet_limit={self.fleet_limit!r}"
        if len(self.fleet_limit) > LONGEST_LIMIT_NAME:
            raise ValueError(f"fleet_limit has at most {LONGEST_LIMIT_NAME} characters")
        if self.concurrency is None:
            raise ValueError(f"{limit} needs a number of goals: set concurrency, too")
        if not self.queue:
            raise ValueError(f"{limit} needs a queue of at least 1, not 0: each goal waits first")
        if self.when_full == "preempt":
            raise ValueError(f"{limit} cannot preempt: the goals that run may be at other workers")


def _check_is_limit(name: str, limit: object, least: int) -> None:
    if limit is None and least:
        return
    if not isinstance(limit, int) or isinstance(limit, bool):
        raise TypeError(f"{name} must be a whole number, not {limit!r}")
    if limit < least:
        raise ValueError(f"{name} must be {least} or more, not {limit}")


def _check_is(name: str, value: object, kind: type, what: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {what}, not {value!r}")


def _check_is_time(name: str, seconds: object) -> None:
    if not isinstance(seconds, int | float):
        raise TypeError(f"{name} must be a number of seconds, not {seconds!r}")
    if name == "handover" and seconds == 0:
        return
    if not seconds > 0:
        least = "0 or more" if name == "handover" else "more than 0"
        raise ValueError(f"{name} must be {least}, not {seconds}")
