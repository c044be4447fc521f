"""The requests of a reader to one writer: whether it has all samples (`CatchUp`), and, at a pace,
those that it lacks (`RequestPace`).

A sample that was lost is noticed by a later one, or by a heartbeat. If it was the last one, that is
the next heartbeat of the writer, which may come seconds later. A reader that has to know it sooner
asks for a heartbeat. It has caught up when the answer has come, and all samples that the answer has
announced.

The answer takes a way to the writer and back. So that a fast sequence of questions costs little, a
question is put only if the last one is `ASK_AGAIN` seconds old, or if a sample of this writer is
missing or was within `REMEMBER` seconds. Otherwise the reader counts as caught up: what is wrong
then is noticed by the next sample or question, and from then on each question is put.

A heartbeat in one datagram with a sample is not an answer: both may be late, so that the heartbeat
is older than the question. A heartbeat that a newer one has overtaken is not one either. A question
without an answer is repeated, and given up after `LONGEST_QUESTION` seconds; if it has one, the
samples are waited for until they come, or until the writer tells that they do not come any more.
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


OVERTAKEN = 0.006
"""Seconds after which a sample is requested that a later one has overtaken. Sooner, a writer of
this library does not answer, because the sample may be on its way."""
SHORTEST_REPEAT, LONGEST_REPEAT = 0.01, 0.5
"""The pause before a request is repeated because of a heartbeat, in seconds: it is twice the one
before if nothing that was requested has come."""
MARGIN = 1.5
"""The pause, as a multiple of the time that the last answer took."""


# The pace of requests: what was requested is on its way, however many heartbeats come meanwhile. It
# is requested again after the time that the last answer took, and somewhat more, so that
# participants that are slow to answer do not make each other slower by answering the same request
# many times.


class AnswerTime:
    """The pause that a participant begins with at a new writer: that of its latest answer."""

    def __init__(self) -> None:
        self.pause = SHORTEST_REPEAT


class RequestPace:
    """The requests to one writer."""

    def __init__(self, latest: AnswerTime) -> None:
        self._latest = latest
        self.requested = 0
        """The last number that was requested."""
        self._begun = -math.inf
        """The time of the first request without an answer."""
        self._at = -math.inf
        self._pause: float | None = None

    def just_requested(self, within: float, now: float) -> bool:
        """Return whether something was requested within so many seconds."""
        return now - self._at < within

    def may_request(self, last: int, now: float) -> bool:
        """Return whether numbers up to the last one may be requested because of a heartbeat. If
        they were requested before, the next pause is twice as long.
        """
        if last > self.requested:
            return True
        pause = self._latest.pause if self._pause is None else self._pause
        is_due = now - self._at >= pause
        if is_due:
            self._pause = min(2 * pause, LONGEST_REPEAT)
        return is_due

    def note_request(self, last: int, now: float) -> None:
        """Note that numbers up to the last one are requested."""
        if last > self.requested:
            self._begun = now
        self.requested, self._at = last, now

    def note_sample(self, now: float) -> None:
        """Note that a sample has come that was requested."""
        if self._begun <= self._at:
            taken = MARGIN * (now - self._begun)
            self._pause = self._latest.pause = min(max(taken, SHORTEST_REPEAT), LONGEST_REPEAT)
            self._begun = math.inf
