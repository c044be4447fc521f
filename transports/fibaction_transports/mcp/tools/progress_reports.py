"""`ProgressReports`: the feedback of a goal as notifications of progress."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

from fibaction.words.progress import Progress, ProgressMeter
from fibaction_transports.mcp.tools.answers import feedback_text

ReportProgress: TypeAlias = Callable[[float, float | None, str | None], Awaitable[None]]
"""Sends the progress, the total if it is known, and a text."""


class ProgressReports:
    """The notifications of progress of one call: of each the progress is larger than before, as the
    protocol demands.
    """

    def __init__(self, send: ReportProgress) -> None:
        self._send = send
        self._meter = ProgressMeter()
        self._told = -math.inf

    async def report(self, number: int, feedback: Any) -> None:
        """Send the progress that a feedback tells, with its total; if it tells none, its number."""
        progress = self._meter.read(feedback) or Progress(number)
        if progress.done > self._told:
            self._told = progress.done
            await self._send(progress.done, progress.total, feedback_text(feedback))
