"""Programs in processes of their own, which take orders and answer in lines of JSON."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import AsyncGenerator, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import anyio
from anyio.abc import Process
from anyio.streams.buffered import BufferedByteReceiveStream

ROOT = Path(__file__).parents[2]
PATIENCE = 120.0
"""Seconds for an answer, many times as long as any order of a benchmark takes."""
STOP_TIMEOUT = 3.0
"""Seconds for the end of a process, which is killed afterwards. rclpy may not stop."""
LONGEST_LINE = 2**26


class Program:
    """Another process."""

    def __init__(self, process: Process, stderr: IO[bytes]) -> None:
        assert process.stdout is not None
        assert process.stdin is not None
        self.process = process
        self._stdin = process.stdin
        self._stdout = BufferedByteReceiveStream(process.stdout)
        self._stderr = stderr

    async def line(self, patience: float = PATIENCE) -> Any:
        """Return its next line.

        Raises:
            RuntimeError: It has ended, or says nothing. The text is the last line of its complaint.
        """
        try:
            with anyio.fail_after(patience):
                return json.loads(await self._stdout.receive_until(b"\n", LONGEST_LINE))
        except (anyio.IncompleteRead, anyio.EndOfStream, TimeoutError) as exc:
            complaint = self.complaints().strip()
            error = RuntimeError(complaint.rpartition("\n")[2] or "it says nothing")
            error.add_note(complaint)
            raise error from exc

    async def tell(self, do: str, **arguments: Any) -> None:
        """Send an order."""
        await self._stdin.send(json.dumps({"do": do, **arguments}).encode() + b"\n")

    async def ask(self, do: str, times: int = 1) -> Any:
        """Send an order to do something so many times, and return the answer."""
        await self.tell(do, times=times)
        return await self.line()

    @property
    def resident(self) -> int:
        """The resident memory of the process, in bytes."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text(encoding="utf-8").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    @property
    def cpu_seconds(self) -> float:
        """The processor time of the process so far."""
        return processor_of(self.process.pid)

    def complaints(self) -> str:
        """Return its standard error so far."""
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")


def processor_of(pid: int) -> float:
    """Return the seconds of the processor that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@asynccontextmanager
async def program(
    python: str | Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> AsyncGenerator[Program, None]:
    """Run a Python program until the block ends."""
    async with opened(python, *arguments, environment=environment) as (process, stderr):
        yield Program(process, stderr)


@asynccontextmanager
async def opened(
    python: str | Path, *arguments: str, environment: Mapping[str, str] | None = None
) -> AsyncGenerator[tuple[Process, IO[bytes]], None]:
    """Run such a program, and yield its process and the file with its standard error."""
    with TemporaryFile() as stderr:
        process = await anyio.open_process(
            [str(python), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            cwd=ROOT,
            env={**os.environ, **(environment or {})},
            start_new_session=True,  # Ctrl-C goes to this process alone, which then stops it
        )
        try:
            yield process, stderr
        finally:
            with anyio.CancelScope(shield=True):
                assert process.stdin is not None
                await process.stdin.aclose()
                with anyio.move_on_after(STOP_TIMEOUT):
                    await process.wait()
                # With its own children, such as a server of NATS.
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                await process.aclose()
