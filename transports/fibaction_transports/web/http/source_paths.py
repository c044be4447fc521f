"""`SourcePaths`: the list of servers at `/servers`, and their topics at `/topics`.

A topic is a stream of MessagePack, each piece after its length in four bytes, the highest first:
the name of the type and the JSON Schema of the messages, then the messages. A client that is slow
gets the newest messages.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import aclosing
from functools import partial
from typing import TypeAlias

import msgspec

from fibaction.border.http_access import Refused
from fibaction.observe.sources import Sources
from fibaction.words.errors import TransportError
from fibaction_transports._http.exchange import Exchange

SERVERS, TOPICS = "/servers", "/topics"
TOPIC_TYPE = "application/x-fibaction-topic"

Read: TypeAlias = Callable[[Exchange], Awaitable[None]]
"""Answers a request that reads."""


class SourcePaths:
    """The answers about the servers whose actions are served."""

    def __init__(self, admit: Callable[[Exchange], object], sources: Sources | None) -> None:
        """Without sources, the lists are empty; `admit` lets in a client, or raises `Refused`."""
        self._admit = admit
        self._sources = sources

    def reader_of(self, path: str) -> Read | None:
        """Return what answers a request that reads a path; None if nothing is there."""
        if path == SERVERS:
            return self._answer_servers
        if path == TOPICS:
            return self._answer_topics
        if path.startswith(f"{TOPICS}/") and self._sources is not None:
            return partial(self._answer_topic, self._sources, path.removeprefix(f"{TOPICS}/"))
        return None

    async def _answer_servers(self, exchange: Exchange) -> None:
        self._admit(exchange)
        infos = [] if self._sources is None else await self._sources.infos()
        await exchange.answer(200, msgspec.json.encode(infos))

    async def _answer_topics(self, exchange: Exchange) -> None:
        self._admit(exchange)
        topics = {} if self._sources is None else self._sources.topics()
        await exchange.answer(200, msgspec.json.encode(topics))

    async def _answer_topic(self, sources: Sources, topic: str, exchange: Exchange) -> None:
        self._admit(exchange)
        refusal = ""
        async with exchange.until_gone(), aclosing(sources.messages(topic)) as pieces:
            try:
                async for piece in pieces:
                    if not exchange.has_begun:
                        exchange.begin_stream(200, TOPIC_TYPE)
                    await exchange.write(len(piece).to_bytes(4, "big") + piece)
            except TransportError as exc:
                refusal = str(exc)
        if exchange.has_begun:
            await exchange.end()
        elif refusal:
            raise Refused(404, refusal)
