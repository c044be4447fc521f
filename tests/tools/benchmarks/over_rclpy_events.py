"""Stock rclpy with deep queues, as in `over_rclpy_deep`, and its newest executor at both ends."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from rclpy.experimental import EventsExecutor

from tests.tools.benchmarks import over_rclpy_deep
from tests.tools.benchmarks.contender import Contender

NAME = "benchmark_rclpy_events"


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_rclpy_deep.serve(NAME, EventsExecutor) as address:
        yield address


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    async with over_rclpy_deep.connect(address, EventsExecutor) as contender:
        yield contender
