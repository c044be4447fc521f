"""The question whether a reader has all samples of one writer.

A sample that was lost is noticed by a later one, or by a heartbeat. If it was the last one, that is
the next heartbeat of the writer, which may come seconds later. A reader that has to know it sooner
asks for a heartbeat. It has caught up when the answer has come, and all samples that the answer has
announced.

The answer takes a way to the writer and back. So that a fast sequence of questions costs little, a
question is put only if the last one is `ASK_AGAIN` seconds old, or if a sample of this writer is
missing or was within `REMEMBER` seconds. Otherwise the reader counts as caught up: what is wrong
then is noticed by the next sample or question, and from then on each question is put.

A heartbeat in one datagram with a sample is not an answer: both may be late, so that the heartbeat
is older than the question. Neither is one that a newer heartbeat has overtaken. A question without
an answer is repeated, and given up after `LONGEST_QUESTION` seconds; if it has one, the samples are
waited for until they come, or until the writer tells that they do not come any more.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from fibaction_transports.rtps.timers import Timers

ASK_AGAIN = 0.1
"""Seconds after which a question is put although no loss was noticed."""
REMEMBER = 10.0
"""Seconds for which a loss is remembered."""
FIRST_REPEAT = 0.02
"""Seconds after which a question without an answer is repeated; each pause is twice the one before.
"""
LONGEST_QUESTION = 0.25
"""Seconds after which a question without an answer is given up."""


class CatchUp:
    """The question whether a reader has all samples of one writer, which is put again and again."""

    def __init__(
        self,
        timers: Timers,
        ask: Callable[[float], None],
        on_end: Callable[[], None],
    ) -> None:
        """`ask` asks for a heartbeat, and `on_end` is called when a question is settled."""
        self._timers = timers
        self._ask = ask
        self._on_end = on_end
        self.is_open = False
        """True if a question has been put and is not settled."""
        self._last: int | None = None
        """The last sample that the answer has announced; None if there is no answer yet."""
        self._asked = -math.inf
        self._lost = -math.inf
        self.sampled_at = -math.inf
        """The time at which a sample has come last."""
        self._count = 0
        self._deadline = -math.inf
        self._pause = FIRST_REPEAT

    def note_loss(self, now: float) -> None:
        """Note that a sample is missing, at least for now."""
        self._lost = now

    def start(self, *, is_complete: bool, now: float) -> None:
        """Put the question, or put it again for what was written since; `is_complete` tells that
        nothing is known to be missing.
        """
        is_quiet = is_complete and now - self._lost > REMEMBER
        if is_quiet and not self.is_open and now - self._asked < ASK_AGAIN:
            return
        self.is_open = True
        self._last = None
        self._deadline = now + LONGEST_QUESTION
        self._pause = FIRST_REPEAT
        self.on_question_due(now)

    def on_question_due(self, now: float) -> None:
        """Ask for the first time or again, or give the question up."""
        if now >= self._deadline:
            self._end()
            return
        self._asked = now
        self._ask(now)
        self._timers.set(self.on_question_due, min(now + self._pause, self._deadline))
        self._pause *= 2

    def hear(self, count: int, last: int, now: float) -> None:
        """Take a heartbeat, with its count and the last sample: it may be the answer."""
        is_new, self._count = count > self._count, max(count, self._count)
        if self.is_open and self._last is None and is_new and now != self.sampled_at:
            self._last = last
            self._timers.cancel(self.on_question_due)

    def settle(self, expected: int) -> None:
        """End if all samples have come before the one that is expected next."""
        if self._last is not None and expected > self._last:
            self._end()

    def close(self) -> None:
        """End: nothing more will come."""
        if self.is_open:
            self._end()

    def _end(self) -> None:
        self._timers.cancel(self.on_question_due)
        self.is_open = False
        self._last = None
        self._on_end()
