"""`serve_metrics`: `/metrics`, `/healthz` and `/readyz` over HTTP, for Prometheus and Kubernetes.

The answers come from a thread, so they come even while an executor blocks the event loop: then
`/healthz` says so. This is HTTP without TLS and without tokens, for the machine itself or for a
network that only the operator has access to.

This is the standard library's server, and not that of `http://`: in a thread there is no event loop
for the latter, and metrics need no extra. Where a `WebTransport` or `http://` serves already,
`metrics=` shows the same at its `/metrics`.
"""

from __future__ import annotations

import socketserver
import threading
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from time import monotonic
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

import anyio

from fibaction.border.event_loop import Background
from fibaction.observe.metrics import Metrics
from fibaction.server import ActionServer
from fibaction.words.errors import TransportError

__all__ = ["serve_metrics"]

STUCK = 5.0
"""Seconds without a turn of the event loop after which the process is not healthy."""
REQUEST_TIMEOUT = 10.0
"""Seconds that a client may take for its request."""


class _Server(socketserver.ThreadingMixIn, WSGIServer):
    daemon_threads = True
    block_on_close = False

    def server_bind(self) -> None:
        """Bind, without a look-up of this machine's name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name = str(self.server_address[0])
        self.server_port = int(self.server_address[1])
        self.setup_environ()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that has gone, or was too slow."""


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_TIMEOUT

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the requests come every few seconds."""


class _Application:
    """The answers, by their paths."""

    def __init__(self, metrics: Metrics, servers: Iterable[ActionServer[Any, Any, Any]]) -> None:
        self._metrics = metrics
        self._servers = tuple(servers)

    def __call__(self, request: dict[str, Any], begin: Callable[..., Any]) -> list[bytes]:
        status, content_type, body = "200 OK", "text/plain; charset=utf-8", b"ok\n"
        path, late = request["PATH_INFO"], monotonic() - self._metrics.beat_at
        if path == "/metrics":
            content_type, body = self._metrics.answer(request.get("HTTP_ACCEPT", ""))
        elif path not in ("/healthz", "/readyz"):
            status, body = "404 Not Found", b"see /metrics, /healthz and /readyz\n"
        elif late > STUCK:
            status = "503 Service Unavailable"
            body = f"the event loop has been blocked for {late:.0f} s\n".encode()
        elif path == "/readyz" and not all(server.is_running for server in self._servers):
            status, body = "503 Service Unavailable", b"a server does not run\n"
        headers = [("Content-Type", content_type), ("Content-Length", str(len(body)))]
        begin(status, headers + ([("Vary", "Accept")] if path == "/metrics" else []))
        return [body]


def serve_metrics(
    metrics: Metrics, address: str, servers: Iterable[ActionServer[Any, Any, Any]] = ()
) -> AbstractAsyncContextManager[str]:
    """Answer `GET /metrics`, `/healthz` and `/readyz` during the block, which gets the URL.

    `address` is `host:port`; without a host it is this machine only, `127.0.0.1`, and port 0 is any
    free one. `/readyz` says whether all of the `servers` run, and `/healthz` whether the event loop
    does. The lag of the event loop is measured meanwhile.

        async with serve_metrics(metrics, "127.0.0.1:9464", [server]):
            ...

    Raises:
        ValueError: The address does not have this form.
        TransportError: Nothing can listen there. The start of the block raises it.
    """
    return _served(metrics, *_host_and_port(address), _Application(metrics, servers))


@asynccontextmanager
async def _served(
    metrics: Metrics, host: str, port: int, application: _Application
) -> AsyncGenerator[str, None]:
    try:
        server = _Server((host, port), _Handler)
    except OSError as exc:
        raise TransportError(f"cannot serve metrics at {host}:{port}: {exc.strerror}") from exc
    server.set_app(application)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), name="metrics")
    thread.start()
    try:
        async with Background() as tasks:
            metrics.beat_at = monotonic()
            tasks.start_soon(metrics.run, name="lag of the event loop")
            yield f"http://{host}:{server.server_port}/metrics"
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(server.shutdown)
            await anyio.to_thread.run_sync(thread.join)
        server.server_close()


def _host_and_port(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not (port.isascii() and port.isdecimal() and int(port) < 65536):
        raise ValueError(f"an address for metrics is like 127.0.0.1:9464 or :9464, not {address!r}")
    return host.strip("[]") or "127.0.0.1", int(port)
