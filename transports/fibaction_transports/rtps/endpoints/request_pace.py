"""The pace at which a reader requests again what one writer has not sent yet.

What was requested is on its way, however many heartbeats come meanwhile. It is requested again
after the time that the last answer took, and somewhat more, so that participants that are slow to
answer do not make each other slower by answering the same request many times.
"""

from __future__ import annotations

import math

OVERTAKEN = 0.006
"""Seconds after which a sample is requested that a later one has overtaken. Sooner, a writer of
this library does not answer, because the sample may be on its way."""
SHORTEST_REPEAT, LONGEST_REPEAT = 0.01, 0.5
"""The pause before a request is repeated because of a heartbeat, in seconds: it is twice the one
before if nothing that was requested has come."""
MARGIN = 1.5
"""The pause, as a multiple of the time that the last answer took."""


class AnswerTime:
    """The pause that a participant begins with at a new writer: that of its latest answer."""

    def __init__(self) -> None:
        self.pause = SHORTEST_REPEAT


class RequestPace:
    """The requests to one writer."""

    def __init__(self, latest: AnswerTime) -> None:
        self._latest = latest
        self._to = 0
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
        if last > self._to:
            return True
        pause = self._latest.pause if self._pause is None else self._pause
        is_due = now - self._at >= pause
        if is_due:
            self._pause = min(2 * pause, LONGEST_REPEAT)
        return is_due

    def note_request(self, last: int, now: float) -> None:
        """Note that numbers up to the last one are requested."""
        if last > self._to:
            self._begun = now
        self._to, self._at = last, now

    def note_sample(self, number: int, now: float) -> None:
        """Note that a sample has come, which may have been requested."""
        if number <= self._to and self._begun <= self._at:
            taken = MARGIN * (now - self._begun)
            self._pause = self._latest.pause = min(max(taken, SHORTEST_REPEAT), LONGEST_REPEAT)
            self._begun = math.inf
