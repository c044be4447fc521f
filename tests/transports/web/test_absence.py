"""A bridge whose server is away: it says so at once, and comes back by itself."""

from __future__ import annotations

import time

import anyio
import pytest

from fibaction import connect, serve
from fibaction.border.endpoints import ForwardingEndpoint
from fibaction.border.streams import StatusStream
from fibaction.feeds import answers
from tests.support.fibonacci import FIBONACCI
from tests.support.ports import free_port
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch, served

pytestmark = pytest.mark.anyio
GOALS = "/actions/fibonacci/goals"


async def until(url: str, path: str, status: int) -> None:
    while (await fetch(url, "GET", path)).status != status:
        pass


async def test_a_server_that_is_away_is_told_at_once_and_everywhere_until_it_is_back() -> None:
    robot = f"tcp://127.0.0.1:{free_port()}"
    began = time.time()
    with anyio.fail_after(60):
        async with (
            connect(robot) as there,
            serve(there.endpoint(FIBONACCI), "http://127.0.0.1:0") as (url,),
        ):
            async with serve(new_server(), robot):
                await until(url, "/readyz", 200)
                assert (await fetch(url, "GET", "/readyz")).body == b"ok\n"
                assert "away" not in (await fetch(url, "GET", "/actions")).json[0]

            await until(url, "/readyz", 503)
            text = b"1 of 1 servers are away\n"
            ready, alive = [await fetch(url, "GET", path) for path in ("/readyz", "/healthz")]
            assert (ready.body, ready.headers["retry-after"]) == (text, "1")
            assert (alive.status, alive.body) == (200, text)
            away = (await fetch(url, "GET", "/actions")).json[0]["away"]
            assert began <= away["since"] <= time.time()
            assert away["reason"]
            assert (await fetch(url, "GET", "/actions/fibonacci")).json["away"]["since"] == (
                away["since"]
            )
            for method, path in (
                ("POST", GOALS),
                ("GET", GOALS),
                ("DELETE", GOALS),
                ("GET", f"{GOALS}/{'a' * 32}"),
                ("PUT", f"{GOALS}/{'a' * 32}"),
                ("GET", f"{GOALS}/{'a' * 32}/events"),
            ):
                body = {"order": 3} if method in ("POST", "PUT") else None
                with anyio.fail_after(5):
                    answer = await fetch(url, method, path, body)
                assert (answer.status, answer.headers["retry-after"]) == (503, "1")
                assert "the server is away since 20" in answer.json["detail"]

            async with serve(new_server(), robot):
                await until(url, "/readyz", 200)
                answer = await fetch(url, "POST", f"{GOALS}?wait=20", {"order": 3})
                assert answer.json["status"] == "SUCCEEDED"


class Frozen(ForwardingEndpoint):
    """A server that does not answer, and does not count as away yet."""

    async def status(self) -> StatusStream:
        await anyio.sleep_forever()
        raise AssertionError


async def test_a_list_does_not_wait_for_a_frozen_server_until_it_counts_as_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(answers, "ANSWERING", 0.05)
    async with served(Frozen(new_server())) as url:
        found = await fetch(url, "GET", "/goals")
        assert (found.status, found.json["away"]) == (200, ["fibonacci"])
        for method, path in (
            ("GET", GOALS),
            ("DELETE", f"{GOALS}?status=active"),
            ("GET", "/actions/fibonacci/stats"),
        ):
            answer = await fetch(url, method, path)
            assert (answer.status, answer.headers["retry-after"]) == (503, "1")
            assert "has not answered for 0.05 s" in answer.json["detail"]
