"""Stock rclpy, as in `over_rclpy`, with queues for a whole batch instead of the default of ten."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager

from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.qos import QoSProfile

from tests.tools.benchmarks import over_rclpy
from tests.tools.benchmarks.contender import Contender

NAME = "benchmark_rclpy_deep"
DEEP = QoSProfile(depth=3000)
SERVICES = {f"{name}_service_qos_profile": DEEP for name in ("goal", "result", "cancel")}


@asynccontextmanager
async def serve(
    name: str = NAME, executor: Callable[[], Executor] = SingleThreadedExecutor
) -> AsyncGenerator[str, None]:
    settings = {"feedback_pub_qos_profile": DEEP, **SERVICES}
    async with over_rclpy.serve(name, executor, **settings) as address:
        yield address


@asynccontextmanager
async def connect(
    address: str, executor: Callable[[], Executor] = SingleThreadedExecutor
) -> AsyncGenerator[Contender, None]:
    settings = {"feedback_sub_qos_profile": DEEP, **SERVICES}
    async with over_rclpy.connect(address, executor, **settings) as contender:
        yield contender
