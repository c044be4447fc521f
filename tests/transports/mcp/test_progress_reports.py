"""The feedback of a goal as notifications of progress."""

from __future__ import annotations

from typing import Any

import pytest

from fibaction_transports.mcp.answers import ProgressReports

pytestmark = pytest.mark.anyio


async def told(*feedbacks: Any) -> list[tuple[float, float | None, str | None]]:
    """Return what is sent for feedback."""
    sent: list[tuple[float, float | None, str | None]] = []

    async def send(progress: float, total: float | None, message: str | None) -> None:
        sent.append((progress, total, message))

    reports = ProgressReports(send)
    for number, feedback in enumerate(feedbacks, 1):
        await reports.report(number, feedback)
    return sent


async def test_feedback_with_progress_is_reported_with_its_total() -> None:
    done = [{"done": number, "total": 8, "text": "wash"} for number in (0, 3)]
    assert await told(*done) == [
        (0, 8, '{"done":0,"total":8,"text":"wash"}'),
        (3, 8, '{"done":3,"total":8,"text":"wash"}'),
    ]
    assert await told({"percent": 20}) == [(20, 100, '{"percent":20}')]


async def test_other_feedback_is_counted() -> None:
    assert await told("a", "b") == [(1, None, "a"), (2, None, "b")]


async def test_progress_that_does_not_increase_is_not_reported() -> None:
    sent = await told(*({"done": done, "total": 8} for done in (1, 1, 0.5, 2)))
    assert [progress for progress, _, _ in sent] == [1, 2]
