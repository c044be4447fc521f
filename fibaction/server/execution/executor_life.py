"""The life of an executor, and of the scopes that it runs in, as two small tables.

An executor is prepared when its goal is accepted, called when the goal has its turn, and gone after
its clean-up. It is interrupted once at most, by whatever comes first.

Scopes are used for one executor after another, until one of them is interrupted: then they are
spent, and no other executor can run in them. An executor that is killed and does not end is spared,
or, if the scopes are doomed, abandoned.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import Final


class ExecutorPhase(IntEnum):
    """A phase of an executor's life."""

    PREPARED = 0
    CALLED = 1
    """It runs, or begins soon."""
    INTERRUPTED = 2
    GONE = 3


class ExecutorEvent(IntEnum):
    """An event in the life of an executor."""

    CALL = 0
    INTERRUPT = 1
    LEAVE = 2


EXECUTOR_LIFE: Final[Mapping[tuple[ExecutorPhase, ExecutorEvent], ExecutorPhase]] = (
    MappingProxyType(
        {
            (ExecutorPhase.PREPARED, ExecutorEvent.CALL): ExecutorPhase.CALLED,
            (ExecutorPhase.PREPARED, ExecutorEvent.INTERRUPT): ExecutorPhase.INTERRUPTED,
            (ExecutorPhase.PREPARED, ExecutorEvent.LEAVE): ExecutorPhase.GONE,
            (ExecutorPhase.CALLED, ExecutorEvent.INTERRUPT): ExecutorPhase.INTERRUPTED,
            (ExecutorPhase.CALLED, ExecutorEvent.LEAVE): ExecutorPhase.GONE,
            (ExecutorPhase.INTERRUPTED, ExecutorEvent.INTERRUPT): ExecutorPhase.INTERRUPTED,
            (ExecutorPhase.INTERRUPTED, ExecutorEvent.LEAVE): ExecutorPhase.GONE,
            (ExecutorPhase.GONE, ExecutorEvent.INTERRUPT): ExecutorPhase.GONE,
        }
    )
)
"""The phase that follows; other events are bugs, and raise KeyError where they happen."""


class ScopesPhase(IntEnum):
    """A phase of the scopes of executors."""

    USABLE = 0
    SPENT = 1
    """A cancellation was delivered in them, or to their task."""
    KILLED = 2
    """Every `await` is canceled; an executor that survives it is spared."""
    DOOMED = 3
    """Every `await` is canceled; an executor that survives it is abandoned."""
    ABANDONED = 4
    """An executor was given up inside, whose own scopes are still open."""


class ScopesEvent(IntEnum):
    """An event that happens to the scopes of executors."""

    INTERRUPT = 0
    KILL = 1
    KILL_FOR_GOOD = 2
    SPARE = 3
    """The executor has survived, and gets no further cancellation until the next kill."""
    ABANDON = 4


SCOPES_LIFE: Final[Mapping[tuple[ScopesPhase, ScopesEvent], ScopesPhase]] = MappingProxyType(
    {(phase, ScopesEvent.INTERRUPT): max(phase, ScopesPhase.SPENT) for phase in ScopesPhase}
    | {(phase, ScopesEvent.KILL): max(phase, ScopesPhase.KILLED) for phase in ScopesPhase}
    | {(phase, ScopesEvent.KILL_FOR_GOOD): max(phase, ScopesPhase.DOOMED) for phase in ScopesPhase}
    | {(ScopesPhase.KILLED, ScopesEvent.SPARE): ScopesPhase.SPENT}
    | {(phase, ScopesEvent.ABANDON): ScopesPhase.ABANDONED for phase in ScopesPhase}
)
"""The phase that follows; other events are bugs, and raise KeyError where they happen."""
