"""Stock rclpy, as in `over_rclpy`, with queues for a whole batch instead of the default of ten."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from rclpy.qos import QoSProfile

from tests.benchmarks import over_rclpy
from tests.benchmarks.contender import Contender

NAME = "benchmark_rclpy_deep"
DEEP = QoSProfile(depth=3000)
SERVICES = {f"{name}_service_qos_profile": DEEP for name in ("goal", "result", "cancel")}


@asynccontextmanager
async def serve() -> AsyncGenerator[str, None]:
    async with over_rclpy.serve(NAME, feedback_pub_qos_profile=DEEP, **SERVICES) as address:
        yield address


@asynccontextmanager
async def connect(address: str) -> AsyncGenerator[Contender, None]:
    settings = {"feedback_sub_qos_profile": DEEP, **SERVICES}
    async with over_rclpy.connect(address, **settings) as contender:
        yield contender
