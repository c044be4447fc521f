"""The list of servers, the streams of their topics, and the probes of one server."""

from __future__ import annotations

from collections.abc import AsyncGenerator

import anyio
import pytest

from fibaction import TransportError, serve
from fibaction.observe.sources import ListedServer, Sources
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio

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
    with anyio.fail_after(20):
        async with serve(new_server(), "http://127.0.0.1:0", sources=Scripted()) as (url,):
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
    with anyio.fail_after(20):
        async with serve(new_server(), "http://127.0.0.1:0", sources=Scripted()) as (url,):
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
    with anyio.fail_after(20):
        async with serve(new_server(), "http://127.0.0.1:0", tokens={"s": "ann"}) as (url,):
            ann = {"authorization": "Bearer s"}
            for path, empty in (("/servers", []), ("/topics", {})):
                assert (await fetch(url, "GET", path)).status == 401
                assert (await fetch(url, "GET", path, **ann)).json == empty
            assert (await fetch(url, "GET", "/topics/arm/odom", **ann)).status == 404
            assert (await fetch(url, "GET", "/readyz/fibonacci")).status == 200
