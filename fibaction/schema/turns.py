"""`in_turn`: the work on documents of strangers, beside the event loop if they are large.

A check is Python, so a thread for it alone would take the interpreter from the event loop for 5 ms
at each of the loop's calls of the system. So the thread pauses about once in a millisecond, and
there is one such thread for an event loop: the documents of all clients wait for each other, in the
order in which they came, and small ones wait for none.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import anyio
import msgspec
from anyio.lowlevel import RunVar

from fibaction.types.collector import collector_paused

T = TypeVar("T")
Pause: TypeAlias = Callable[[], None]

SMALL = 2048
"""Bytes of a document that is checked at once: it takes less than a millisecond."""
PAUSE = 50e-6
"""Seconds of a pause, in which the event loop gets the interpreter if it waits for it."""

_turn = RunVar[anyio.CapacityLimiter]("_turn")


async def in_turn(size: int | None, work: Callable[[Pause | None], T]) -> T:
    """Return what the work on a document of so many bytes returns; None if that is not known.

    The work of a large one is done in a thread, and calls what it gets about once in a millisecond;
    that of a small one is done at once, and gets None.
    """
    if size is not None and size <= SMALL:
        return work(None)
    limiter = _turn.get(None)
    if limiter is None:
        limiter = anyio.CapacityLimiter(1)
        _turn.set(limiter)
    return await anyio.to_thread.run_sync(work, _pause, limiter=limiter)


def read_json(text: bytes | str) -> Any:
    """Return the data in a JSON text.

    Raises:
        ValueError: It is not JSON.
        RecursionError: It nests too deeply.
    """
    with collector_paused():
        return msgspec.json.decode(text)


def _pause() -> None:
    time.sleep(PAUSE)  # noqa: TID251  # it lets go of the interpreter's lock
