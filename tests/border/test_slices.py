from __future__ import annotations

import anyio
import pytest

from fibaction.border import event_loop as slices_module
from fibaction.border.event_loop import SLICE, Slices

pytestmark = pytest.mark.anyio


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, in the only item of a list."""
    times = [100.0]
    monkeypatch.setattr(slices_module, "perf_counter", lambda: times[0])
    return times


async def test_others_have_a_turn_when_a_slice_is_over_and_not_before(now: list[float]) -> None:
    turns: list[float] = []

    async def take_turns() -> None:
        while True:
            turns.append(now[0])
            await anyio.lowlevel.checkpoint()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(take_turns)
        slices = Slices()
        for step in (0.0, SLICE / 2):
            now[0] += step
            await slices.pause()
        assert turns == []
        for _ in range(5):
            now[0] += SLICE
            await slices.pause()
        assert len(turns) >= 3
        turns.clear()
        await slices.pause()  # the next slice begins after the pause
        assert turns == []
        tasks.cancel_scope.cancel()


async def test_a_cancellation_does_not_arrive_in_a_pause(now: list[float]) -> None:
    with anyio.CancelScope() as scope:
        scope.cancel()
        slices = Slices()
        now[0] += SLICE
        await slices.pause()
        now[0] = 0.0
    assert now == [0.0]
