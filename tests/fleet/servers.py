"""Processes of nats-server: one, or a cluster, each with JetStream in a folder of its own."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

PROGRAM = shutil.which("nats-server", path=str(Path(sys.executable).parent)) or shutil.which(
    "nats-server"
)
"""The path of nats-server; None if it is not installed."""


def free_ports(count: int) -> list[int]:
    """Return ports of this machine where no server listens."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


class Servers:
    """Processes of nats-server, which keep their ports and their data when they start again."""

    def __init__(self, folder: Path, count: int) -> None:
        self._folder = folder
        self._names = [f"n{number}" for number in range(count)]
        self._ports = free_ports(2 * count)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        for name in self._names:
            self.start(name)
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for name in tuple(self._processes):
            self.kill(name)

    @property
    def names(self) -> list[str]:
        """The names of the servers, which they have in the cluster, too."""
        return self._names

    @property
    def hosts(self) -> str:
        """The addresses of all servers, as a URL of a fleet lists them."""
        return ",".join(f"127.0.0.1:{port}" for port in self._ports[: len(self._names)])

    @property
    def urls(self) -> list[str]:
        """The addresses of all servers, as NATS writes them."""
        return [f"nats://{host}" for host in self.hosts.split(",")]

    def start(self, name: str) -> None:
        """Start a server, at the port and with the data that it had."""
        assert PROGRAM is not None
        number, count = self._names.index(name), len(self._names)
        command = [PROGRAM, "-a", "127.0.0.1", "-p", str(self._ports[number])]
        command += ["-n", name, "-js", "-sd", str(self._folder / name)]
        if count > 1:
            routes = [f"nats://127.0.0.1:{port}" for port in self._ports[count:]]
            command += ["--cluster_name", "trial", "--cluster", routes[number]]
            command += ["--routes", ",".join(routes)]
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def kill(self, name: str) -> None:
        """End a server at once."""
        process = self._processes.pop(name)
        process.kill()
        process.wait()

    @contextmanager
    def frozen(self, name: str) -> Iterator[None]:
        """Freeze a server while the block lasts."""
        process = self._processes[name]
        os.kill(process.pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(process.pid, signal.SIGCONT)
