"""`FeedbackPosition`: where in a task an agent was, when it comes back.

Each update has its position as text in its metadata, `event_id`: `17` for feedback, or `2.17` in
the second attempt at the goal, as the events of the REST interface have it; `result` for the
artifact. An agent sends the last one that it has seen in the header `Last-Event-ID`.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from a2a.utils.errors import InvalidParamsError

RESULT = "result"
"""The position after the artifact."""

_PATTERN = re.compile(r"(?:([1-9]\d{0,8})\.)?(\d{1,18})", re.ASCII)


class FeedbackPosition(NamedTuple):
    """A position in the updates of a task; positions are compared."""

    has_result: bool = False
    attempt: int = 1
    number: int = 0

    def __str__(self) -> str:
        if self.has_result:
            return RESULT
        return str(self.number) if self.attempt == 1 else f"{self.attempt}.{self.number}"


START = FeedbackPosition()
"""The position before the first update."""


def position_of(text: str) -> FeedbackPosition:
    """Return the position in a header `Last-Event-ID`.

    Raises:
        InvalidParamsError: It is not one.
    """
    if text == RESULT:
        return FeedbackPosition(has_result=True)
    found = _PATTERN.fullmatch(text)
    if found is None:
        raise InvalidParamsError(
            f"the header Last-Event-ID is the event_id of an update, such as 17, not {text!r}"
        )
    return FeedbackPosition(attempt=int(found[1] or 1), number=int(found[2]))
