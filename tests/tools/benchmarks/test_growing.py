"""Many active goals: who does not bear them, and what is said of that."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.tools.benchmarks import growing
from tests.tools.benchmarks.ways import WAYS, Pair, Way

pytestmark = pytest.mark.asyncio


class Bearing:
    """A client that bears so many active goals."""

    resident = 10**6

    def __init__(self, most: int) -> None:
        self._most = most
        self._held = 0

    async def ask(self, do: str, times: int = 1) -> Any:
        if do == "hold":
            self._held += times
        if self._held > self._most:
            raise RuntimeError("too many")
        return [times, times * 0.01]


def bearing(monkeypatch: pytest.MonkeyPatch, **most: int) -> None:
    @asynccontextmanager
    async def started(way: Way) -> AsyncGenerator[Pair, None]:
        (key,) = (key for key, one in WAYS.items() if one is way)
        end: Any = Bearing(most.get(key, 10**6))
        yield Pair(end if way.has_server else None, end)

    async def kept(_scale: float) -> dict[str, float]:
        return {}

    monkeypatch.setattr(growing, "started", started)
    monkeypatch.setattr(growing, "kept", kept)


async def test_a_peer_that_does_not_bear_so_many_is_left_out_and_the_others_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bearing(monkeypatch, grpc=1000)
    without: dict[str, str] = {}
    memory, growth = await growing.growth(without, 1)
    assert without == {"grpc": "it failed with 10,000 active goals"}
    assert set(growth["ways"]) == {"inproc", "tcp"}
    assert set(memory["ways"]) == {"inproc", "tcp_server", "tcp_client"}
