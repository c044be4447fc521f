"""`Retry`: the rule by which `ActionClient.call` tries again, without running a goal twice."""

from __future__ import annotations

from typing import cast

from fibaction._runtime.settings_struct import SettingsStruct
from fibaction.words.errors import (
    ActionError,
    ConnectionLost,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalTimeout,
    LimitReached,
    ServerNotFound,
    UnknownGoal,
)
from fibaction.words.plain_data import check_is_number

_SAFE: tuple[type[ActionError], ...] = (
    ServerNotFound,
    ConnectionLost,
    LimitReached,
    GoalRejected,
)
_AFTER_A_RUN = (GoalAborted, GoalCanceled, GoalTimeout, UnknownGoal)

_MOST_DOUBLINGS = 60
"""More would be a number that no float can hold, and each delay is limited anyway."""


class Retry(SettingsStruct, frozen=True, kw_only=True):
    """The rule by which `ActionClient.call` tries again, without running a goal twice.

    A goal keeps its ID. Until its acceptance is known, the same goal is sent again; a server that
    knows it gives the first answer again. From then on the goal is only followed again: it is never
    sent a second time.

    For example:

        await client.call(3, timeout=60, retry=Retry(attempts=5, delay=0.5))
    """

    attempts: int = 3
    """The number of attempts in all, the first one included."""
    delay: float = 0.5
    """Seconds before the second attempt. Each further delay is twice as long. Each delay is
    shortened at random, by half at most, so that the clients of a busy server do not come back
    together."""
    max_delay: float = 10.0
    """Seconds that a delay takes at most."""
    on: tuple[type[ActionError], ...] = _SAFE
    """The errors after which there is another attempt: all of `ServerNotFound`, `ConnectionLost`,
    `LimitReached` and `GoalRejected`, or some of them. A rejection is retried only if the server is
    busy or stopping (`RejectionCode.is_temporary`): any other one is a decision."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TypeError: `attempts` is not a whole number, a delay is not a number, or `on` is
                not a tuple of error classes.
            ValueError: A number is out of range, or a class of `on` cannot be retried.
        """
        attempts = cast("object", self.attempts)
        if not isinstance(attempts, int):
            raise TypeError(f"attempts must be a whole number, not {attempts!r}")
        if attempts < 1:
            raise ValueError(f"attempts must be 1 or more, not {attempts}")
        for name, seconds in (("delay", self.delay), ("max_delay", self.max_delay)):
            check_is_number(name, seconds)
            if not 0 <= seconds < float("inf"):
                raise ValueError(f"{name} must be a number of seconds, 0 or more, not {seconds}")
        if self.max_delay < self.delay:
            raise ValueError(
                f"max_delay must be at least the delay of {self.delay:g} s,"
                f" not {self.max_delay:g} s"
            )
        _check_are_safe(self.on)

    def is_for(self, error: ActionError) -> bool:
        """Return whether there may be another attempt after this error."""
        if isinstance(error, GoalRejected) and not error.code.is_temporary:
            return False
        return isinstance(error, self.on)

    def delay_before(self, attempt: int) -> float:
        """Return the seconds to wait before an attempt: 2 for the second, 3 for the third."""
        doubled: float = self.delay * 2.0 ** min(attempt - 2, _MOST_DOUBLINGS)
        import random  # here, since most programs never retry, and it takes milliseconds

        return min(doubled, self.max_delay) * random.uniform(0.5, 1)  # not a secret


def _check_are_safe(classes: object) -> None:
    """Raise an error if a goal could run twice after one of these classes of errors."""
    if not isinstance(classes, tuple):
        raise TypeError(
            f"on must be a tuple of error classes, such as (ServerNotFound,), not {classes!r}"
        )
    names = ", ".join(kind.__name__ for kind in _SAFE)
    for kind in cast("tuple[type[object], ...]", classes):
        if kind in _AFTER_A_RUN:
            raise ValueError(
                f"on does not take {kind.__name__}: such a goal has run, or may have, and running"
                f" it again is the caller's decision; on takes {names}"
            )
        if kind not in _SAFE:
            name = getattr(kind, "__name__", repr(kind))
            raise ValueError(f"on does not take {name}, only {names}")
