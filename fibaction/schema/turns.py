"""`in_turn`: the work on documents of strangers, beside the event loop if they are large.

A check is Python, so a thread for it alone would take the interpreter from the event loop for 5 ms
at each of the loop's calls of the system. So the thread pauses about once in a millisecond, and
there is one such thread for an event loop: the documents of all clients wait for each other, in the
order in which they came, and small ones wait for none.

The thread helps only if nothing keeps the interpreter for long. msgspec is slow with numbers such
as `1e308`, and one call reads a whole text: with a megabyte of them, no thread of the process runs
for seconds. Python's own parser is fast with these, so `read_json` leaves such texts to it.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable
from itertools import islice
from typing import Any, Generic, NoReturn, TypeAlias, TypeVar

import anyio
import msgspec
from anyio.lowlevel import RunVar

from fibaction.types.action import collector_paused

T = TypeVar("T")
Pause: TypeAlias = Callable[[], None]

SMALL = 2048
"""Bytes of a document that is checked at once: it takes less than a millisecond."""
PAUSE = 50e-6
"""Seconds of a pause, in which the event loop gets the interpreter if it waits for it."""

MOST_COSTLY = 100
"""Numbers with an exponent of three digits or more that msgspec reads."""

_COSTLY = re.compile(r"[0-9.][eE][+-]?[0-9]{3}")
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")
_COSTLY_BYTES = re.compile(_COSTLY.pattern.encode())

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
    done = await anyio.to_thread.run_sync(_Done, work, limiter=limiter)
    return done.result()


class _Done(Generic[T]):
    """The outcome of some work, which is done at once.

    An error that a thread raises is in a cycle with the frame that waits for it. It would keep the
    document until the garbage collector comes.
    """

    def __init__(self, work: Callable[[Pause | None], T]) -> None:
        self._error: Exception | None = None
        # Each collection would go through all parts of the document, and find nothing.
        with collector_paused():
            try:
                self._result = work(_pause)
            except Exception as exc:
                self._error = exc

    def result(self) -> T:
        """Return what the work has returned, or raise its error, once."""
        if self._error is None:
            return self._result
        error, self._error = self._error, None
        try:
            raise error
        finally:
            del error


def _pause() -> None:
    time.sleep(PAUSE)  # noqa: TID251  # it lets go of the interpreter's lock


def has_costly_numbers(text: bytes | str) -> bool:
    """Return whether msgspec would take long for the numbers of a text."""
    found = _COSTLY.finditer(text) if isinstance(text, str) else _COSTLY_BYTES.finditer(text)
    return next(islice(found, MOST_COSTLY, None), None) is not None


def read_json(text: bytes | str) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: It is not JSON, or has a number that is too large for a float, or half of a
            character.
        RecursionError: It is nested too deeply.
    """
    if not has_costly_numbers(text):
        return msgspec.json.decode(text)
    text = text if isinstance(text, str) else text.decode()
    value = json.loads(text, parse_float=_float, parse_constant=_reject)
    if _SURROGATE.search(text):
        # A pair is one character by now; half of one cannot be encoded.
        json.dumps(value, ensure_ascii=False).encode()
    return value


def _float(text: str) -> float:
    number = float(text)
    if math.isinf(number):
        _reject(text)
    return number


def _reject(text: str) -> NoReturn:
    raise ValueError(f"{text[:20]} is not a number of JSON, or is out of range")
