"""`fibaction_transports.web.http.recording_answer`: the file, who gets it, and when it is away."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

from fibaction import serve
from fibaction_transports.web import HttpTransport
from tests.transports.tcp.servers import new_server
from tests.transports.web.http_client import fetch

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["asyncio", "trio"])
def anyio_backend(request: pytest.FixtureRequest) -> Any:
    return request.param


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
            assert (refused.status, refused.headers["allow"]) == (405, "GET, HEAD")
            file.unlink()
            gone = await fetch(url, "GET", "/recording", authorization=token)
            assert gone.status == 404
            assert b"the recording cannot be read: No such file" in gone.body
