"""Idle servers and clients use next to no processor time, because nothing polls quickly."""

from __future__ import annotations

from contextlib import AsyncExitStack
from time import perf_counter

import anyio
import pytest

from tests.ros2.stock.process import peer

pytestmark = pytest.mark.anyio

SECONDS = 2.5
MOST = 0.1
"""Limit, as a share of a core. The aim is 0.02, and it is some 0.005; tests may run slowly."""
SETTLING = 0.5
"""Seconds after which discovery is over."""
WAYS = {
    "an idle server": ("serve_it", "idle"),
    "a server at the user's node": ("serve_at_a_node", "idle_at_a_node"),
    "a client that waits for a result": ("wait", "idle"),
    "a client that waits for a server": ("look_for", "nobody"),
}


async def test_idle_programs_use_next_to_no_processor_time() -> None:
    async with AsyncExitStack() as stack:
        peers = {
            name: await stack.enter_async_context(peer("ours", *way, "asyncio"))
            for name, way in WAYS.items()
        }
        await anyio.sleep(SETTLING)
        before = {name: one.cpu_seconds for name, one in peers.items()}
        start = perf_counter()
        await anyio.sleep(SECONDS)
        seconds = perf_counter() - start
        used = {name: (one.cpu_seconds - before[name]) / seconds for name, one in peers.items()}

    for name, share in used.items():
        print(f"{name}: {share:.1%} of a core")
    assert max(used.values()) < MOST, used
