"""The cost of goals over TCP, beside gRPC, and beside the least that anyio's sockets need."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import AsyncExitStack
from importlib.metadata import PackageNotFoundError, version
from statistics import median
from typing import Any

from tests.tools.benchmarks import over_fibaction, over_grpc, over_sockets
from tests.tools.benchmarks.contender import AT_ONCE, Contender
from tests.tools.benchmarks.program import program
from tests.tools.benchmarks.timing import Work, in_turn

CONTENDERS = {"fibaction": over_fibaction, "grpc": over_grpc, "bare": over_sockets}


async def measure(scale: float) -> dict[str, Any]:
    try:
        grpcio = version("grpcio")
    except PackageNotFoundError:
        raise SystemExit("grpcio is not installed: `make bench` installs it") from None
    async with AsyncExitStack() as stack:
        contenders: list[Contender] = []
        for module in CONTENDERS.values():
            child = (
                "-m",
                "tests.tools.benchmarks.child",
                "server",
                module.__name__.partition("over_")[2],
            )
            server = await stack.enter_async_context(program(sys.executable, *child))
            address = await server.line()
            contenders.append(await stack.enter_async_context(module.connect(address)))

        async def compare(
            work: Callable[[Contender], Work], times: float, *, each: int = 1, **targets: float
        ) -> dict[str, float]:
            """Measure; `each` is the number of items in one of the `times`."""
            rounds = await in_turn(*map(work, contenders), times=max(1, int(times * scale)))
            columns = zip(CONTENDERS, zip(*rounds, strict=True), strict=True)
            return {
                **{f"{name}_per_second": round(each / median(of)) for name, of in columns},
                "fibaction_to_grpc": round(median(grpc / ours for ours, grpc, _ in rounds), 3),
                "fibaction_to_bare": round(median(bare / ours for ours, _, bare in rounds), 3),
                **targets,
            }

        return {
            "grpcio": grpcio,
            "goals, one after another": await compare(
                lambda contender: contender.goals, 2500, target_to_grpc=3, target_to_bare=0.5
            ),
            f"goals, {AT_ONCE} at once": await compare(
                lambda contender: contender.batches, 8, each=AT_ONCE, target_to_grpc=3
            ),
            "feedback of one goal": await compare(whole_feedback, 20_000, target_to_grpc=15),
        }


def whole_feedback(contender: Contender) -> Work:
    async def read(times: int) -> None:
        assert await contender.feedback(times) == times, "feedback was lost"

    return read
