"""The settings of an `ActionServer`, each with its default and its check.

`ActionServerSettings` is what the parts of a server read; `ActionServerKeywords` is what the
constructor takes, for type checkers.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from typing import Generic, Literal, TypeAlias, TypedDict

import msgspec

from fibaction.border.goal_store import GoalStore
from fibaction.border.watchers import Watcher
from fibaction.server.admission.sender_argument import GoalFunction
from fibaction.server.goal_handle import GoalHandle
from fibaction.server.registry.registry import MAX_BYTES, MAX_GOALS
from fibaction.server.scheduling.schedule import Schedule
from fibaction.types.action import GoalT
from fibaction.words.plain_data import check_is_number

CancelFunction: TypeAlias = Callable[[GoalHandle[GoalT]], Awaitable[None] | None]
"""A sync or async function that returns None to accept, and raises a rejection to reject."""
RecoveryFunction: TypeAlias = Callable[[GoalHandle[GoalT]], Awaitable[None] | None]
"""A sync or async function that returns None to run a goal again, and raises `GoalAborted` to end
it."""
RecoveryRule: TypeAlias = Literal["abort", "rerun"] | RecoveryFunction[GoalT]

WORDS = (
    ("feedback", "every", "latest"),
    ("unreadable", "refuse", "abort"),
    ("at_stop", "abort", "keep"),
)
AT_LEAST_ONE = ("feedback_window", "max_attempts")
NOT_NEGATIVE = (
    "stall_timeout",
    "result_timeout",
    "given_up_timeout",
    "max_results",
    "max_goals",
    "max_bytes",
    "shutdown_timeout",
    "watchdog",
    "log_lines",
)
MOST_LOG_LINES = 1000


class ActionServerKeywords(TypedDict, Generic[GoalT], total=False):
    """The keyword arguments of `ActionServer`: see `ActionServerSettings`."""

    on_goal: GoalFunction[GoalT, Awaitable[None] | None] | None
    on_cancel: CancelFunction[GoalT] | None
    interrupt_on_cancel: bool
    feedback: Literal["every", "latest"]
    feedback_window: int
    stall_timeout: float
    result_timeout: float
    given_up_timeout: float
    max_results: int
    max_goals: int
    max_bytes: int
    shutdown_timeout: float
    schedule: Schedule | None
    store: GoalStore | None
    recovery: RecoveryRule[GoalT]
    max_attempts: int
    unreadable: Literal["refuse", "abort"]
    at_stop: Literal["abort", "keep"]
    watchdog: float
    log_lines: int
    watchers: Iterable[Watcher]


class ActionServerSettings(msgspec.Struct, Generic[GoalT], frozen=True, kw_only=True):
    """The settings of one server."""

    on_goal: GoalFunction[GoalT, Awaitable[None] | None] | None = None
    """A function that is called with each goal of the right type, and with its `Sender` if it has a
    second parameter, and raises `GoalRejected` to reject the goal. Without it, every such goal is
    accepted."""
    on_cancel: CancelFunction[GoalT] | None = None
    """A function that is called with the `GoalHandle` of each goal to cancel, and raises
    `CancelRejected` to reject the cancel. Without it, every cancel is accepted."""
    interrupt_on_cancel: bool = True
    """If true, an accepted cancel raises the backend's cancellation in the executor. If false, the
    executor has to check `goal.cancel_requested` itself."""
    feedback: Literal["every", "latest"] = "every"
    """With `every`, no feedback is lost, and the executor waits at its `yield` for the goal's own
    client. With `latest`, it never waits, and a slow reader gets the newest feedback."""
    feedback_window: int = 64
    """The number of feedback messages of a goal that are remembered. So many may be unread before
    the executor waits, or before a slow reader loses the oldest."""
    stall_timeout: float = 10.0
    """Seconds that the executor waits for a client that does not read."""
    result_timeout: float = 10.0
    """Seconds that an outcome is kept after the goal's end; 0 not at all, `math.inf` forever. A
    client that already waits for it always gets it."""
    given_up_timeout: float = 7 * 24 * 3600.0
    """Seconds that a store keeps a goal that was given up, with the goal itself and its checkpoint,
    so that `fibaction store rerun` can run it again: one that ended because attempts were lost, or
    because it could not be read. With 0, only its outcome is kept, as that of other goals."""
    max_results: int = 1000
    """The number of outcomes that are kept at most; the oldest are forgotten. A store keeps as many
    goals that were given up."""
    max_goals: int = MAX_GOALS
    """The number of goals that may be active, or be decided upon, at the same time; more are
    rejected with the code `BUSY`."""
    max_bytes: int = MAX_BYTES
    """The bytes of goals until their end, of remembered feedback, and of results, together. Over it
    new goals are rejected as `BUSY`, outcomes are forgotten, the oldest of the client that holds
    most first, and executors wait until their feedback is read."""
    shutdown_timeout: float = 5.0
    """Seconds that executors have for their clean-up when the server stops. Then they are killed,
    and those that do not end are abandoned about a second later."""
    schedule: Schedule | None = None
    """The rules by which accepted goals run, wait and give way; None to run all of them at once."""
    store: GoalStore | None = None
    """The place in which goals outlive this process; None to keep them in memory only."""
    recovery: RecoveryRule[GoalT] = "abort"
    """The rule for goals that were running when the server was killed, at its next start with the
    same store. With `abort`, they end as ABORTED; with `rerun`, they run again, from their last
    checkpoint if they have made one. A function is called with the `GoalHandle` of each, and
    returns None to run it again, or raises `GoalAborted`. Goals that have not begun run in any
    case."""
    max_attempts: int = 3
    """The number of attempts that a goal may lose in this way without a new checkpoint; then it
    ends as ABORTED."""
    unreadable: Literal["refuse", "abort"] = "refuse"
    """The rule for goals that the store has at the start, and that do not fit the action any more,
    or for which the `key` or the `priority` of the schedule fails. With `refuse`, the server does
    not start, and leaves the store as it is for the version that can read them; with `abort`, they
    end as ABORTED. In a fleet, such goals are left to the workers that can read them, and with
    `abort`, one that no living worker could read for ten leases ends as ABORTED."""
    at_stop: Literal["abort", "keep"] = "abort"
    """With `abort`, a server that stops ends its goals. With `keep`, it interrupts their executors,
    and goals that do not end by themselves stay in the store: they run again after the next
    start."""
    watchdog: float = 1.0
    """Seconds that an executor may block the event loop before the log names its goal and its line
    of code; 0 is never. The time at a debugger's breakpoint counts, and so may the time for which
    the computer sleeps or is too busy."""
    log_lines: int = 0
    """The newest log records of each goal's executor that are kept for clients with the permission
    `OBSERVE`, at most 1000 of a goal; 0 for none. They are those that your loggers let pass, of the
    1000 goals that have logged last, and are not in a store."""
    watchers: Iterable[Watcher] = ()
    """Objects that see everything that happens to goals: metrics, recordings and others."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: The schedule is not a `Schedule`, the store is not a `GoalStore`, or a number
                is something else.
            ValueError: A number is out of range; or `feedback`, `recovery`, `unreadable` or
                `at_stop` is not one of its words.
        """
        for name, one, other in WORDS:
            if (word := getattr(self, name)) not in (one, other):
                raise ValueError(f"{name} must be {one!r} or {other!r}, not {word!r}")
        for least, names in ((1, AT_LEAST_ONE), (0, NOT_NEGATIVE)):
            for name in names:
                value = getattr(self, name)
                check_is_number(name, value)
                if not value >= least:
                    bound = "0 or more" if not least else "at least 1"
                    raise ValueError(f"{name} must be {bound}, not {value}")
        if self.log_lines > MOST_LOG_LINES:
            raise ValueError(f"log_lines must be at most {MOST_LOG_LINES}, not {self.log_lines}")
        if not (self.recovery in ("abort", "rerun") or callable(self.recovery)):
            raise ValueError(
                f"recovery must be 'abort', 'rerun' or a function, not {self.recovery!r}"
            )
        if self.schedule is not None:
            _check_is_schedule(self.schedule)
        if self.store is not None:
            check_is_store(self.store)


def _check_is_schedule(schedule: object) -> None:
    if not isinstance(schedule, Schedule):
        raise TypeError(f"schedule must be a Schedule, not {schedule!r}")


def check_is_store(store: object) -> None:
    """Raise TypeError for what is not a store."""
    if not isinstance(store, GoalStore):
        raise TypeError(f"store must be a GoalStore, such as SqliteStore(path), not {store!r}")
