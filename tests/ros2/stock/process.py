"""Other processes, which take commands and answer them: a line of JSON each way."""

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
PATIENCE = 30.0
"""Seconds for an answer: several times those of the slowest answer on a busy machine, and more than
the 20 after which DDS misses a process that was killed, as is one that does not end by itself."""
END_PATIENCE = 3.0
"""Seconds for the end. rclpy may not stop; then the process is killed."""
PROFILES_FILE = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""The variables that name the file with the settings of Fast DDS: of Fast DDS 3, which Kilted has,
and of Fast DDS 2 of Jazzy."""
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
        """Return the next line that it prints."""
        try:
            with anyio.fail_after(patience):
                return json.loads(await self._lines.receive_until(b"\n", LONGEST_LINE))
        except (anyio.IncompleteRead, anyio.EndOfStream, TimeoutError) as exc:
            raise AssertionError(f"it printed nothing; its errors: {self.complaints()}") from exc

    async def ask(self, do: str, **arguments: Any) -> Any:
        """Send it a command, and return its answer."""
        assert self.process.stdin is not None
        await self.process.stdin.send(json.dumps({"do": do, **arguments}).encode() + b"\n")
        answer = await self.line()
        assert "error" not in answer, answer["error"]
        return answer["answer"]

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    async def ended(self, patience: float = PATIENCE) -> int:
        """Wait for its end, and return its exit code."""
        with anyio.fail_after(patience):
            return await self.process.wait()

    def complaints(self) -> str:
        """Return its standard error so far."""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")

    @property
    def cpu_seconds(self) -> float:
        """Its processor time, with all its threads."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    @property
    def threads(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))


@asynccontextmanager
async def peer(module: str, *arguments: str, **environment: str) -> AsyncGenerator[Peer, None]:
    """Run a module, by default of this package, that prints a line when it is ready."""
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
