"""A server in a process of its own, and three goals over TCP: canceled, succeeded, rejected."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGTERM, raise_signal, signal

import anyio
from anyio.abc import Process
from anyio.streams.text import TextReceiveStream
from fibonacci import FIBONACCI, MAX_ORDER
from fibonacci_client import run_goal

from fibaction import connect

SERVER = Path(__file__).with_name("fibonacci_server.py")
ANY_PORT = "tcp://127.0.0.1:0"
PERIOD = 0.3  # seconds per number: slow enough to be read
STOP_TIMEOUT = 7.0  # seconds: more than the server gives its executors to clean up


async def main() -> None:
    """Start the server, run three goals one after the other, stop the server."""
    async with server_process() as url, connect(url, FIBONACCI) as client:
        print(f"The server is another process, at {url}.")
        print("\n1. A goal that is canceled half-way ends with what there was by then.\n")
        await run_goal(client, 10, cancel_after=5)
        print("\n2. A goal that is left alone ends with all of it.\n")
        await run_goal(client, 10)
        print("\n3. A goal that cannot be met is rejected, and the server says why.\n")
        await run_goal(client, MAX_ORDER + 1)


@asynccontextmanager
async def server_process() -> AsyncGenerator[str, None]:
    """Run the server while the block lasts; gives its URL."""
    command = [sys.executable, str(SERVER), "--url", ANY_PORT, "--period", str(PERIOD)]
    # A session of its own: Ctrl-C is for this process, which then stops the server in good order.
    started = await anyio.open_process(command, stderr=subprocess.PIPE, start_new_session=True)
    async with started as process:
        try:
            yield await url_of(process)
        finally:
            with suppress(ProcessLookupError):  # it has ended by itself
                process.terminate()
            with anyio.move_on_after(STOP_TIMEOUT, shield=True):
                await process.wait()


async def url_of(process: Process) -> str:
    """Read where the server is from the first line that it prints.

    Raises:
        RuntimeError: It has ended instead; the text is what it says about that.
    """
    assert process.stdout is not None
    assert process.stderr is not None
    line = ""
    async for text in TextReceiveStream(process.stdout):
        line += text
        if "\n" in line:
            return line.partition(" at ")[2].partition(",")[0]
    complaint = "".join([text async for text in TextReceiveStream(process.stderr)])
    await process.wait()
    raise RuntimeError(complaint.strip())


if __name__ == "__main__":
    # A kill or a terminal that is closed must not leave the server behind, either.
    for other in (SIGTERM, SIGHUP):
        signal(other, lambda number, frame: raise_signal(SIGINT))
    try:
        anyio.run(main)
    except KeyboardInterrupt:
        pass
    except RuntimeError as exc:
        sys.exit(f"the server did not start: {exc}")
