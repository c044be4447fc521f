"""A server in its own process, and three goals over TCP: canceled, succeeded, rejected."""

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
    """Start the server, run three goals one after the other, and stop the server."""
    async with server_process() as url, connect(url, FIBONACCI) as client:
        print(f"The server is another process, at {url}.")
        print("\n1. A goal that is canceled half-way ends with the numbers so far.\n")
        await run_goal(client, 10, cancel_after=5)
        print("\n2. A goal that is not canceled ends with all numbers.\n")
        await run_goal(client, 10)
        print("\n3. A goal that the server cannot compute is rejected with a reason.\n")
        await run_goal(client, MAX_ORDER + 1)


@asynccontextmanager
async def server_process() -> AsyncGenerator[str, None]:
    """Run the server for the duration of the block, and yield its URL."""
    command = [sys.executable, str(SERVER), "--url", ANY_PORT, "--period", str(PERIOD)]
    # In its own session, the server does not get Ctrl-C; this process stops it in good order.
    started = await anyio.open_process(command, stderr=subprocess.PIPE, start_new_session=True)
    async with started as process:
        try:
            yield await url_of(process)
        finally:
            with suppress(ProcessLookupError):  # it has already ended
                process.terminate()
            with anyio.move_on_after(STOP_TIMEOUT, shield=True):
                await process.wait()


async def url_of(process: Process) -> str:
    """Return the server's URL, which is in the first line that it prints.

    Raises:
        RuntimeError: The server has ended instead; the text is its error.
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
    # After a kill or a closed terminal, too, the server must not be left running.
    for other in (SIGTERM, SIGHUP):
        signal(other, lambda number, frame: raise_signal(SIGINT))
    try:
        anyio.run(main)
    except KeyboardInterrupt:
        pass
    except RuntimeError as exc:
        sys.exit(f"the server did not start: {exc}")
