"""Checks of the arguments of `ActionServer`, each of which raises one clear sentence."""

from __future__ import annotations

import inspect
from functools import partial

from fibaction.border.goal_store import GoalStore
from fibaction.server.scheduling.schedule import Schedule


def check_recovery(recovery: object, max_attempts: int) -> None:
    """Raise ValueError for a rule of recovery, or a number of attempts, that cannot be."""
    if not (recovery in ("abort", "rerun") or callable(recovery)):
        raise ValueError(f"recovery is 'abort', 'rerun' or a function, not {recovery!r}")
    if max_attempts < 1:
        raise ValueError(f"max_attempts is at least 1, not {max_attempts}")


def check_is_store(store: object) -> None:
    """Raise TypeError for what is not a store."""
    if not isinstance(store, GoalStore):
        raise TypeError(f"store is a GoalStore, such as SqliteStore(path), not {store!r}")


def check_is_schedule(schedule: object) -> None:
    """Raise TypeError for what is not a schedule."""
    if not isinstance(schedule, Schedule):
        raise TypeError(f"schedule is a Schedule, not {schedule!r}")


def check_is_executor(executor: object) -> None:
    """Raise TypeError for a function that is not an async generator function.

    This finds a forgotten `async` or `yield` before the first goal. The value that a lambda returns
    is known only when it is called, so a goal checks that.
    """
    while isinstance(executor, partial):
        executor = executor.func
    if not callable(executor):
        raise TypeError(f"the executor is an async generator function, and not {executor!r}")
    name = getattr(executor, "__name__", type(executor).__name__)
    for function in (executor, executor.__call__):
        if inspect.iscoroutinefunction(function):
            raise TypeError(
                f"the executor {name!r} is a coroutine function: yield its feedback, and yield its"
                f" result last, instead of returning it"
            )
        if inspect.isgeneratorfunction(function):
            raise TypeError(
                f"the executor {name!r} is a generator function that is not async: write"
                f" `async def`, and await what takes time"
            )
