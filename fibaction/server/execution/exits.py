"""Finds whether a coroutine waits in an exit that expects a cancellation by level."""

from __future__ import annotations

from collections.abc import Generator
from gc import get_referents
from types import FrameType
from typing import Any

from anyio import get_cancelled_exc_class

BY_LEVEL = ("anyio", "trio")
"""The packages whose code expects that each `await` is canceled until its scope is left."""

BENEATH = (*BY_LEVEL, "asyncio", "contextlib")
"""The packages in whose code that of the first ones waits."""

_KINDS = (("cr_frame", "cr_await"), ("ag_frame", "ag_await"), ("gi_frame", "gi_yieldfrom"))
"""The attributes of what can wait: its frame, and what it awaits."""


def leaves_by_level(coroutine: Any) -> bool:
    """Return whether the coroutine waits in the `__aexit__` of a resource of `BY_LEVEL` that its
    cancellation passes, and not in other code which that calls.
    """
    canceled, leaves = get_cancelled_exc_class(), False
    for frame in _frames_of(coroutine):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package not in BENEATH:
            leaves = False
        elif package in BY_LEVEL and frame.f_code.co_name == "__aexit__":
            leaves = leaves or any(isinstance(one, canceled) for one in frame.f_locals.values())
    return leaves


def _frames_of(awaited: Any) -> Generator[FrameType, None, None]:
    """Yield the frames of a coroutine that waits, from the outermost one."""
    while awaited is not None:
        kind = next((one for one in _KINDS if hasattr(awaited, one[0])), None)
        if kind is not None:
            yield getattr(awaited, kind[0])
            awaited = getattr(awaited, kind[1])
        else:  # a step of an async generator names it to the garbage collector only
            steps: list[Any] = [one for one in get_referents(awaited) if hasattr(one, "ag_await")]
            awaited = steps[0] if steps else None
