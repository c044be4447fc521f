"""`fibaction bridge` as a process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from signal import SIGTERM

import anyio
from anyio.abc import Process
from anyio.streams.buffered import BufferedByteReceiveStream

from tests.support.processes import PATIENCE


@asynccontextmanager
async def bridge(*arguments: str) -> AsyncGenerator[Process, None]:
    """Run the command until it bridges; stop it by SIGTERM at the end."""
    command = Path(sys.executable).with_name("fibaction")
    process = await anyio.open_process(
        [str(command), "bridge", *arguments], stdin=subprocess.DEVNULL, stderr=None
    )
    async with process:
        try:
            assert process.stdout is not None
            with anyio.fail_after(PATIENCE):
                said = await BufferedByteReceiveStream(process.stdout).receive_until(b"\n", 1000)
            assert said.startswith(b"bridging ")
            yield process
            process.send_signal(SIGTERM)
            with anyio.fail_after(PATIENCE):
                code = await process.wait()
            assert code == 0, f"it ended with the code {code}"
        finally:
            if process.returncode is None:
                process.kill()
