"""Other processes, which do as they are told: a line of JSON each way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import anyio
from anyio.abc import Process
from anyio.streams.buffered import BufferedByteReceiveStream

ROOT = Path(__file__).parents[3]
PATIENCE = 20.0
"""Seconds for an answer: several times what the slowest takes on a busy machine."""
END_PATIENCE = 3.0
"""Seconds for the end: rclpy may not stop, and is killed then."""
LONGEST_LINE = 10_000_000
TICKS = os.sysconf("SC_CLK_TCK")


class Peer:
    """Another process."""

    def __init__(self, process: Process, stderr: IO[bytes]) -> None:
        assert process.stdout is not None
        self.process = process
        self._lines = BufferedByteReceiveStream(process.stdout)
        self._stderr = stderr

    async def line(self, patience: float = PATIENCE) -> Any:
        """What it says next."""
        try:
            with anyio.fail_after(patience):
                return json.loads(await self._lines.receive_until(b"\n", LONGEST_LINE))
        except (anyio.IncompleteRead, anyio.EndOfStream, TimeoutError) as exc:
            raise AssertionError(f"it says nothing, but complains: {self.complaints()}") from exc

    async def ask(self, do: str, **arguments: Any) -> Any:
        """Tell it to do something, and give what it says to that."""
        assert self.process.stdin is not None
        await self.process.stdin.send(json.dumps({"do": do, **arguments}).encode() + b"\n")
        answer = await self.line()
        assert "error" not in answer, answer["error"]
        return answer["answer"]

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    async def ended(self, patience: float = PATIENCE) -> int:
        """Its exit code."""
        with anyio.fail_after(patience):
            return await self.process.wait()

    def complaints(self) -> str:
        """What it has written to standard error so far."""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")

    @property
    def cpu_seconds(self) -> float:
        """How long it has computed, with all its threads."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    @property
    def threads(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))


@asynccontextmanager
async def peer(module: str, *arguments: str, **environment: str) -> AsyncGenerator[Peer, None]:
    """Run a module, of this package if no other is named, that says a line when it is ready."""
    name = module if "." in module else f"{__package__}.{module}"
    with TemporaryFile() as stderr:
        process = await anyio.open_process(
            [sys.executable, "-m", name, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            cwd=ROOT,
            env={**os.environ, **environment},
            start_new_session=True,  # a Ctrl-C is for the tests alone
        )
        found = Peer(process, stderr)
        try:
            await found.line()
            yield found
        finally:
            with anyio.CancelScope(shield=True):
                assert process.stdin is not None
                await process.stdin.aclose()
                with anyio.move_on_after(END_PATIENCE):
                    await process.wait()
                if process.returncode is None:
                    process.kill()
                await process.aclose()
