"""Programs of ROS in processes of their own, which take commands and answer them."""

from __future__ import annotations

import signal
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

import anyio

from tests.support.json_program import Program, opened

PATIENCE = 30.0
"""Seconds for an answer: several times those of the slowest answer on a busy machine, and more than
the 20 after which DDS misses a process that was killed, as is one that does not end by itself."""
PROFILES_FILE = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""The variables that name the file with the settings of Fast DDS: of Fast DDS 3, which Kilted has,
and of Fast DDS 2 of Jazzy."""


class Peer(Program):
    """Another process, whose answers may be errors."""

    async def line(self, patience: float = PATIENCE) -> Any:
        """Return the next line that it prints."""
        return await super().line(patience)

    async def ask(self, do: str, **arguments: Any) -> Any:  # type: ignore[override]  # any arguments
        """Send it a command, and return its answer."""
        await self.tell(do, **arguments)
        answer = await self.line()
        assert "error" not in answer, answer["error"]
        return answer["answer"]

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    async def ended(self, patience: float = PATIENCE) -> int:
        """Wait for its end, and return its exit code."""
        with anyio.fail_after(patience):
            return await self.process.wait()


@asynccontextmanager
async def peer(module: str, *arguments: str, **environment: str) -> AsyncGenerator[Peer, None]:
    """Run a module, by default of this package, that prints a line when it is ready."""
    name = module if "." in module else f"{__package__}.{module}"
    async with opened(sys.executable, "-m", name, *arguments, environment=environment) as process:
        found = Peer(*process)
        await found.line()
        yield found
