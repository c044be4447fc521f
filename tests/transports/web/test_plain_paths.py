"""The paths that are only read: metrics, probes, a recording, servers and topics."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from pathlib import Path

import anyio
import pytest

from fibaction import TransportError, connect, serve
from fibaction.observe.metrics import CONTENT_TYPE, OPENMETRICS_CONTENT_TYPE, Metrics
from fibaction.observe.sources import ListedServer, Sources
from fibaction_transports.web import HttpTransport
from tests.support.fibonacci import FIBONACCI, Goal
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch, served

pytestmark = pytest.mark.anyio


async def test_metrics_are_at_the_address_of_the_server() -> None:
    metrics = Metrics()
    transport = HttpTransport(port=0, metrics=metrics)
    async with served(where=transport, watchers=[metrics]) as url:
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
    async with served(where=HttpTransport(port=0, metrics=metrics)) as url:
        with anyio.fail_after(30):
            while b"lag_seconds_count 0.0" in (await fetch(url, "GET", "/metrics")).body:
                pass


async def test_metrics_need_a_token_and_probes_need_none() -> None:
    transport = HttpTransport(port=0, metrics=Metrics(), tokens={"secret": "prometheus"})
    async with served(where=transport) as url:
        assert (await fetch(url, "GET", "/metrics")).status == 401
        token = "Bearer secret"
        assert (await fetch(url, "GET", "/metrics", authorization=token)).status == 200
        for path in ("/healthz", "/readyz"):
            assert (await fetch(url, "GET", path)).body == b"ok\n"


async def test_without_metrics_there_is_nothing_and_a_probe_is_read_only() -> None:
    async with served() as url:
        assert (await fetch(url, "GET", "/metrics")).status == 404
        answer = await fetch(url, "POST", "/healthz", {})
        assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD, OPTIONS")


async def test_the_recording_arrives_whole_to_a_client_with_a_token(tmp_path: Path) -> None:
    file = tmp_path / "today.jsonl"
    file.write_bytes(b'{"event": "server"}\n' * 20_000)
    transport = HttpTransport(port=0, recording=file, tokens={"secret": "ann"})
    async with served(where=transport) as url:
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


SERVERS = [ListedServer("arm", "tcp://arm", ["arm/pick"]), ListedServer("far", "dds://", [])]


class Scripted(Sources):
    """Two servers, one of which is away; a topic that ends, and one that cannot be read further."""

    async def infos(self) -> list[ListedServer]:
        return SERVERS

    def reached(self) -> dict[str, bool]:
        return {"arm": True, "far": False}

    def topics(self) -> dict[str, str]:
        return {"arm/odom": "nav_msgs/msg/Odometry"}

    def __init__(self) -> None:
        self.began, self.ended = anyio.Event(), anyio.Event()

    async def messages(self, topic: str) -> AsyncGenerator[bytes, None]:
        if topic == "arm/silent":
            self.began.set()
            try:
                await anyio.sleep_forever()
            finally:
                self.ended.set()
        if topic not in self.topics():
            raise TransportError(f"there is no topic {topic}")
        yield b"type"
        yield b"message"


async def test_servers_and_topics_are_listed_and_a_topic_is_a_stream_of_pieces() -> None:
    async with served(sources=Scripted()) as url:
        servers = (await fetch(url, "GET", "/servers")).json
        assert [server["name"] for server in servers] == ["arm", "far"]
        assert (await fetch(url, "GET", "/topics")).json == Scripted().topics()
        topic = await fetch(url, "GET", "/topics/arm/odom")
        assert (topic.status, topic.body) == (200, b"\0\0\0\4type\0\0\0\7message")
        missing = await fetch(url, "GET", "/topics/arm/none")
        assert (missing.status, missing.json["detail"]) == (404, "there is no topic arm/none")
        assert (await fetch(url, "POST", "/servers")).status == 405


async def test_a_topic_is_not_read_after_its_client_has_gone() -> None:
    sources = Scripted()
    with anyio.fail_after(20):
        async with (
            serve(new_server(), "http://127.0.0.1:0", sources=sources) as (url,),
            anyio.create_task_group() as tasks,
        ):
            tasks.start_soon(fetch, url, "GET", "/topics/arm/silent")
            await sources.began.wait()
            tasks.cancel_scope.cancel()
        await sources.ended.wait()


async def test_the_probe_of_a_server_is_about_that_server() -> None:
    async with served(sources=Scripted()) as url:
        for path, status in {
            "/readyz": 503,
            "/readyz/arm": 200,
            "/readyz/far": 503,
            "/healthz/far": 200,
            "/readyz/fibonacci": 200,
            "/readyz/none": 404,
        }.items():
            assert (await fetch(url, "GET", path)).status == status, path
        assert (await fetch(url, "GET", "/readyz")).body == b"1 of 2 servers are away\n"


async def test_without_sources_the_lists_are_empty_and_a_token_is_asked_for() -> None:
    async with served(tokens={"s": "ann"}) as url:
        ann = {"authorization": "Bearer s"}
        for path, empty in (("/servers", []), ("/topics", {})):
            assert (await fetch(url, "GET", path)).status == 401
            assert (await fetch(url, "GET", path, **ann)).json == empty
        assert (await fetch(url, "GET", "/topics/arm/odom", **ann)).status == 404
        assert (await fetch(url, "GET", "/readyz/fibonacci")).status == 200
