"""A participant of this process, and its events."""

from __future__ import annotations

import os
import struct
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import anyio

from fibaction_transports.rtps.endpoints.reader import DataReader
from fibaction_transports.rtps.endpoints.writer import DataWriter
from fibaction_transports.rtps.events import Event, SampleReceived
from fibaction_transports.rtps.network import ParticipantNetwork, open_network
from fibaction_transports.rtps.ports import DomainSettings
from fibaction_transports.rtps.qos import Qos
from tests.support.processes import PATIENCE

E = TypeVar("E")
TEXT = "std_msgs::msg::dds_::String_"


def text(value: str) -> bytes:
    content = value.encode() + b"\0"
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(content)) + content


def text_of(payload: bytes) -> str:
    (size,) = struct.unpack_from("<I", payload, 4)
    return payload[8 : 7 + size].decode()


class RtpsEnd:
    """A participant of this process, and its events."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.network: ParticipantNetwork
        self._news = anyio.Event()

    def note(self, event: Event) -> None:
        self.events.append(event)
        self._news.set()

    async def until(self, is_done: Callable[[], object]) -> None:
        """Wait until something holds after an event."""
        while not is_done():
            self._news = anyio.Event()
            await self._news.wait()

    def all(self, kind: type[E]) -> list[E]:
        return [event for event in self.events if isinstance(event, kind)]

    def payloads(self, reader: DataReader) -> list[bytes]:
        """Return what a reader has received so far."""
        found = self.all(SampleReceived)
        return [event.sample.payload for event in found if event.reader == reader.guid]

    def texts(self, reader: DataReader) -> list[str]:
        """Return the texts that a reader has received so far."""
        return [text_of(payload) for payload in self.payloads(reader)]

    async def until_heard(self, reader: DataReader, count: int) -> None:
        """Wait until a reader has received so many texts."""
        await self.until(lambda: len(self.texts(reader)) >= count)

    async def reader(self, topic: str, qos: Qos) -> DataReader:
        """Make a reader, and wait until it has a writer."""
        reader = self.network.create_reader(topic, TEXT, qos)
        await self.until(lambda: reader.writers)
        return reader

    async def writer(self, topic: str, qos: Qos, readers: int = 1) -> DataWriter:
        """Make a writer, and wait until it has so many readers."""
        writer = self.network.create_writer(topic, TEXT, qos)
        await self.until(lambda: len(writer.readers) == readers)
        return writer


@asynccontextmanager
async def rtps_end() -> AsyncGenerator[RtpsEnd, None]:
    """Join the domain of the environment."""
    found = RtpsEnd()
    settings = DomainSettings.from_environment(os.environ)
    with anyio.fail_after(PATIENCE):
        async with open_network(settings, found.note) as found.network:
            yield found
