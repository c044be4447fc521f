"""ROS 2: fibaction at both ends beside stock rclpy at both ends, each end in its own process."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import AsyncExitStack, asynccontextmanager
from importlib.util import find_spec
from statistics import median, quantiles
from time import perf_counter
from typing import Any, TypeAlias

import anyio

CONTENDERS = ("fibaction", "rclpy")
ROUNDS = 5
ORDER = 10
"""The order of a goal with feedback, which has nine messages."""
MESSAGES = 2700
PENDING = 200
AT_ONCE = 500
PATIENCE = 10.0
"""Seconds after which unanswered goals count as lost."""
IDLE = 3.0
"""Seconds in which processor time is measured."""

Pair: TypeAlias = dict[str, Any]
"""The `Peer`s of one contender: its client and its server."""


async def measure(scale: float) -> dict[str, Any]:
    if find_spec("rclpy") is None:
        raise SystemExit("rclpy is not installed: `make ros` makes .venv-ros, which has it")
    async with AsyncExitStack() as stack:
        pairs = {name: await stack.enter_async_context(peers(name)) for name in CONTENDERS}
        report: dict[str, Any] = {"idle, share of a core": await idle(pairs)}
        times = max(10, int(300 * scale))
        report["goals, one after another"] = await one_after_another(pairs, times)
        report[f"feedback of {times} goals of order {ORDER}"] = await feedback(
            pairs, times, ORDER, times * (ORDER - 1)
        )
        messages = int(MESSAGES * scale)
        report["feedback of one goal"] = await feedback(pairs, 1, 10_000 + messages, messages)
        report[f"one more goal, with none and with {PENDING} pending"] = await growth(
            pairs, max(10, int(60 * scale))
        )
        # Last, because it changes the state of rclpy.
        report[f"goals, {AT_ONCE} at once"] = await at_once(pairs)
    return report


@asynccontextmanager
async def peers(contender: str) -> AsyncGenerator[Pair, None]:
    """Run the comparisons, in a ROS domain of their own, as tests do."""
    from tests.ros2 import conftest  # noqa: F401  # here, because others run without ROS
    from tests.ros2.stock.process import peer

    module = f"tests.tools.benchmarks.ros2_{contender}"
    async with peer(module, "server") as server, peer(module, "client") as client:
        yield {"server": server, "client": client}


async def idle(pairs: dict[str, Pair]) -> dict[str, float]:
    """Measure idle processor time. The client of rclpy spins only while it waits for a goal."""
    await anyio.sleep(1)  # discovery goes on for a while
    before = {name: [peer.cpu_seconds for peer in pair.values()] for name, pair in pairs.items()}
    start = perf_counter()
    await anyio.sleep(IDLE)
    seconds = perf_counter() - start
    return {
        f"{name}_{end}": round((peer.cpu_seconds - used) / seconds, 4)
        for name, pair in pairs.items()
        for (end, peer), used in zip(pair.items(), before[name], strict=True)
    } | {"target": 0.02}


async def one_after_another(pairs: dict[str, Pair], times: int) -> dict[str, float]:
    taken: dict[str, list[list[float]]] = {name: [] for name in CONTENDERS}
    for pair in pairs.values():
        await pair["client"].ask("goals", times=times // 5)
    for _ in range(ROUNDS):
        for name, pair in pairs.items():
            taken[name].append(await pair["client"].ask("goals", times=times))
    report: dict[str, float] = {}
    for name, rounds in taken.items():
        hundredths = quantiles([one for each in rounds for one in each], n=100)
        report[f"{name}_per_second"] = round(times / median(map(sum, rounds)))
        report[f"{name}_p50_ms"] = round(hundredths[49] * 1e3, 2)
        report[f"{name}_p95_ms"] = round(hundredths[94] * 1e3, 2)
    both = zip(taken["fibaction"], taken["rclpy"], strict=True)
    report["fibaction_to_rclpy"] = round(median(sum(rclpy) / sum(ours) for ours, rclpy in both), 3)
    return {**report, "target": 1.0}


async def feedback(
    pairs: dict[str, Pair], times: int, order: int, messages: int
) -> dict[str, float]:
    report: dict[str, float] = {"messages": messages}
    for name, pair in pairs.items():
        arrived, seconds = await pair["client"].ask("feedback", times=times, order=order)
        report[f"{name}_arrived"] = arrived
        report[f"{name}_arrived_per_second"] = round(arrived / seconds)
        report[f"{name}_goals_per_second"] = round(times / seconds, 1)
    return report


async def growth(pairs: dict[str, Pair], times: int) -> dict[str, float]:
    """Return the medians of goals, taken in turns without and with many pending goals."""
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in CONTENDERS}
    for _ in range(ROUNDS):
        for name, pair in pairs.items():
            client = pair["client"]
            none = median(await client.ask("goals", times=times))
            await client.ask("hold", times=PENDING)
            many = median(await client.ask("goals", times=times))
            await client.ask("release")
            seconds[name].append((none, many))
    report: dict[str, float] = {}
    for name, rounds in seconds.items():
        report[f"{name}_ms_with_0"] = round(median(none for none, _ in rounds) * 1e3, 2)
        report[f"{name}_ms_with_{PENDING}"] = round(median(many for _, many in rounds) * 1e3, 2)
        report[f"{name}_cost_ratio"] = round(median(many / none for none, many in rounds), 2)
    return {**report, "target_at_most": 3.0}


async def at_once(pairs: dict[str, Pair]) -> dict[str, float]:
    report: dict[str, float] = {}
    for name, pair in pairs.items():
        done, seconds = await pair["client"].ask("batch", times=AT_ONCE, patience=PATIENCE)
        report[f"{name}_succeeded"] = done
        report[f"{name}_seconds"] = round(seconds, 2)
    return report
