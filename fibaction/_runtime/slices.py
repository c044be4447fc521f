"""`Slices`: bulk work done in slices, between which the rest of the program has its turns."""

from __future__ import annotations

from time import perf_counter

from anyio.lowlevel import cancel_shielded_checkpoint

SLICE = 0.001
"""Seconds of a slice: what a client's request for very many goals may delay all other clients."""


class Slices:
    """The slices of one piece of work, the first of which begins now.

    slices = Slices()
    for goal in goals:
        ...
        await slices.pause()
    """

    __slots__ = ("_end",)

    def __init__(self) -> None:
        self._end = perf_counter() + SLICE

    async def pause(self) -> None:
        """Give all other tasks a turn if the slice is over.

        It is not a cancellation point, so the work is done as a whole or not at all.
        """
        if perf_counter() >= self._end:
            await cancel_shielded_checkpoint()
            self._end = perf_counter() + SLICE
