"""`/metrics`, `/healthz`, `/readyz` and `/recording`, at the address of a server."""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest

from fibaction import connect, serve
from fibaction.observe.metrics import CONTENT_TYPE, OPENMETRICS_CONTENT_TYPE, Metrics
from fibaction_transports.web import HttpTransport
from tests.support.fibonacci import FIBONACCI, Goal
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio


async def test_metrics_are_at_the_address_of_the_server() -> None:
    metrics = Metrics()
    transport = HttpTransport(port=0, metrics=metrics)
    async with serve(new_server(), transport, watchers=[metrics]) as (url,):
        async with connect(url, FIBONACCI) as client:
            await client.call(Goal(2))
        answer = await fetch(url, "GET", "/metrics")
        assert (answer.status, answer.headers["content-type"]) == (200, CONTENT_TYPE)
        ended = b'fibaction_goals_total{action="fibonacci",status="SUCCEEDED"} 1.0'
        assert ended in answer.body
        assert (await fetch(url, "HEAD", "/metrics")).body == b""
        accept = "application/openmetrics-text;version=1.0.0;q=0.5,*/*;q=0.1"
        answer = await fetch(url, "GET", "/metrics", accept=accept)
        assert answer.headers["content-type"] == OPENMETRICS_CONTENT_TYPE
        assert answer.headers["vary"] == "Accept, Accept-Encoding"
        assert ended in answer.body
        assert answer.body.endswith(b"# EOF\n")


async def test_the_lag_of_the_event_loop_is_measured_meanwhile() -> None:
    metrics = Metrics()
    async with serve(new_server(), HttpTransport(port=0, metrics=metrics)) as (url,):
        with anyio.fail_after(30):
            while b"lag_seconds_count 0.0" in (await fetch(url, "GET", "/metrics")).body:
                pass


async def test_metrics_need_a_token_and_probes_need_none() -> None:
    transport = HttpTransport(port=0, metrics=Metrics(), tokens={"secret": "prometheus"})
    async with serve(new_server(), transport) as (url,):
        assert (await fetch(url, "GET", "/metrics")).status == 401
        token = "Bearer secret"
        assert (await fetch(url, "GET", "/metrics", authorization=token)).status == 200
        for path in ("/healthz", "/readyz"):
            assert (await fetch(url, "GET", path)).body == b"ok\n"


async def test_without_metrics_there_is_nothing_and_a_probe_is_read_only() -> None:
    async with serve(new_server(), "http://127.0.0.1:0") as (url,):
        assert (await fetch(url, "GET", "/metrics")).status == 404
        answer = await fetch(url, "POST", "/healthz", {})
        assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD, OPTIONS")


async def test_the_recording_arrives_whole_to_a_client_with_a_token(tmp_path: Path) -> None:
    file = tmp_path / "today.jsonl"
    file.write_bytes(b'{"event": "server"}\n' * 20_000)
    transport = HttpTransport(port=0, recording=file, tokens={"secret": "ann"})
    with anyio.fail_after(30):
        async with serve(new_server(), transport) as (url,):
            assert (await fetch(url, "GET", "/recording")).status == 401
            token = "Bearer secret"
            answer = await fetch(url, "GET", "/recording", authorization=token)
            assert (answer.status, answer.body) == (200, file.read_bytes())
            assert answer.headers["content-type"] == "application/jsonl"
            head = await fetch(url, "HEAD", "/recording", authorization=token)
            assert (head.status, head.body) == (200, b"")
            refused = await fetch(url, "DELETE", "/recording", authorization=token)
            assert (refused.status, refused.headers["allow"]) == (405, "GET, HEAD, OPTIONS")
            file.unlink()
            gone = await fetch(url, "GET", "/recording", authorization=token)
            assert gone.status == 404
            assert b"the recording cannot be read: No such file" in gone.body
