"""`serve_metrics`: the answers over HTTP, also while the event loop is blocked."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request

import anyio
import pytest

from fibaction import ActionServer, TransportError
from fibaction.observe.metrics import CONTENT_TYPE, OPENMETRICS_CONTENT_TYPE, Metrics
from fibaction.observe.metrics_server import STUCK, serve_metrics
from tests.support.fibonacci import FIBONACCI, fibonacci

asynchronous = pytest.mark.anyio


def answer(url: str, accept: str = "*/*") -> tuple[int, str, str]:
    """Return the status, the text and the type of an answer; it blocks the event loop meanwhile."""
    request = urllib.request.Request(url, headers={"Accept": accept})
    try:
        with urllib.request.urlopen(request, timeout=10) as response:
            return response.status, response.read().decode(), response.headers["Content-Type"]
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode(), error.headers["Content-Type"]


@asynchronous
async def test_metrics_and_health_are_at_their_paths() -> None:
    metrics, server = Metrics(), ActionServer(FIBONACCI, fibonacci)
    async with serve_metrics(metrics, ":0", [server]) as url:
        assert url.startswith("http://127.0.0.1:")
        root = url.removesuffix("/metrics")
        assert answer(f"{root}/readyz")[:2] == (503, "a server does not run\n")
        async with server:
            assert answer(f"{root}/readyz")[:2] == (200, "ok\n")
        assert answer(f"{root}/healthz")[:2] == (200, "ok\n")
        assert answer(root)[:2] == (404, "see /metrics, /healthz and /readyz\n")
        assert "fibaction_goals" in answer(url)[1]
        assert answer(url)[2] == CONTENT_TYPE
        status, text, kind = answer(url, "application/openmetrics-text")
        assert (status, kind) == (200, OPENMETRICS_CONTENT_TYPE)
        assert text.endswith("# EOF\n")


@asynchronous
async def test_a_blocked_event_loop_is_not_healthy() -> None:
    metrics = Metrics()
    async with serve_metrics(metrics, "127.0.0.1:0") as url:
        metrics.beat_at -= STUCK + 1
        status, text, _ = answer(url.replace("/metrics", "/healthz"))

    assert status == 503
    assert text.startswith("the event loop has been blocked for ")


@asynchronous
async def test_a_client_that_goes_early_is_ignored(capfd: pytest.CaptureFixture[str]) -> None:
    async with serve_metrics(Metrics(), "127.0.0.1:0") as url:
        host, port = url.removeprefix("http://").removesuffix("/metrics").split(":")
        with socket.create_connection((host, int(port))) as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            client.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert answer(url)[0] == 200

    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("address", ["here:", "here:x", ":65536"])
def test_an_address_of_another_form_is_an_error(address: str) -> None:
    with pytest.raises(ValueError, match=r"^an address for metrics is like 127\.0\.0\.1:9464"):
        serve_metrics(Metrics(), address)


@asynchronous
async def test_an_address_that_is_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as used:
        address = f"127.0.0.1:{used.getsockname()[1]}"
        with pytest.raises(TransportError, match=rf"^cannot serve metrics at {address}: "):
            async with serve_metrics(Metrics(), address):
                pass


@asynchronous
async def test_the_lag_is_measured_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    metrics, measured = Metrics(), anyio.Event()

    async def run() -> None:
        measured.set()

    monkeypatch.setattr(metrics, "run", run)
    async with serve_metrics(metrics, ":0"):
        with anyio.fail_after(10):
            await measured.wait()
