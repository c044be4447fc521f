"""Attacks with JSON documents, through the doors for the web."""

from __future__ import annotations

from contextlib import suppress
from functools import partial

import anyio

from fibaction.wire.settings import Limits
from tests.hostile.attack import attack
from tests.hostile.documents import DOCUMENTS, Document
from tests.hostile.raw_client import Lost, Target

MOST = Limits().frame
"""Bytes of the largest document that a server reads."""


async def post(target: Target, path: str, body: bytes) -> int:
    """Send a request on a connection of its own, and return the status of its answer."""
    host, _, port = target.web.partition("://")[2].rpartition(":")
    head = f"POST {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    async with await anyio.connect_tcp(host, int(port)) as stream:
        await stream.send(head.encode() + body)
        return int((await stream.receive())[9:12])


async def documents(target: Target, clients: int, names: list[str]) -> None:
    """Send documents of the largest size by REST, from many clients at once."""

    async def one(body: bytes, document: Document) -> None:
        with suppress(*Lost):
            status = await post(target, f"/actions/{document.action}/goals", body)
            assert status in (201 if document.is_goal else 422, 503), status

    for name in names:
        body = DOCUMENTS[name].text(target.size(MOST // 2, MOST)).encode()
        async with anyio.create_task_group() as tasks:
            for _ in range(clients):
                tasks.start_soon(one, body, DOCUMENTS[name])


for _name in DOCUMENTS:
    attack(f"documents: {_name}", above=128)(partial(documents, clients=1, names=[_name]))
attack("documents at once", above=192, long=True)(
    partial(documents, clients=10, names=list(DOCUMENTS))
)
