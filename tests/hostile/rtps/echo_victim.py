"""The participant that is attacked, in a process of its own: it answers what it is asked.

A meter measures the turns of its event loop, and its memory. It keeps some large samples for late
readers, which an attacker may request.
"""

from __future__ import annotations

import asyncio  # noqa: TID251  # the meter is a selector of its loop
import os
import resource
import sys
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from signal import SIGTERM
from typing import NamedTuple

import anyio

from fibaction_transports.rtps.events import Event, SampleReceived
from fibaction_transports.rtps.messages.ids import Address
from fibaction_transports.rtps.network import open_network
from fibaction_transports.rtps.ports import DomainSettings, ParticipantSockets
from fibaction_transports.rtps.qos import Durability, Qos
from tests.hostile.meter import Meter
from tests.hostile.victim import MOST_MEMORY
from tests.transports.rtps.world import TYPE, payload

ASKED, ANSWERED, LARGE = "rq/echo", "rr/echo", "rt/large"
"""The topics of questions, of answers, and of the large samples."""
KEPT, SIZE = 20, 100_000
"""The number of large samples, and the bytes of each."""


class EchoIdentity(NamedTuple):
    """What an attacker knows of its victim: all of it is told to everyone on the network."""

    domain: int
    prefix: bytes
    address: Address
    reader: bytes
    writer: bytes
    large: bytes


class CountingSockets:
    """Counts the bytes that a participant sends."""

    def __init__(self, total: Synchronized[int]) -> None:
        send = ParticipantSockets.send

        def counted(sockets: ParticipantSockets, datagram: bytes, address: Address) -> None:
            send(sockets, datagram, address)
            total.value += len(datagram)

        ParticipantSockets.send = counted  # type: ignore[assignment,method-assign]  # here only


async def echo(domain: int, test: Connection) -> None:
    """Answer until SIGTERM; the test is told the identity first."""

    def answer(event: Event) -> None:
        if isinstance(event, SampleReceived):
            network.write(writer, event.sample.payload)

    with anyio.open_signal_receiver(SIGTERM) as signals:
        async with open_network(DomainSettings(domain=domain), answer) as network:
            reader = network.create_reader(ASKED, TYPE, Qos(depth=None))
            writer = network.create_writer(ANSWERED, TYPE, Qos(depth=10))
            late = Qos(durability=Durability.TRANSIENT_LOCAL, depth=KEPT)
            large = network.create_writer(LARGE, TYPE, late)
            for _ in range(KEPT):
                network.write(large, payload("x" * SIZE))
            entities = (each.guid.entity for each in (reader, writer, large))
            own = network.participant._participants._own
            address = own.discovery_locators[0].udp_address
            test.send((domain, own.prefix, address, *entities))
            await anext(signals)


def run(
    test: Connection, orders: Connection, log: str, domain: int, total: Synchronized[int]
) -> None:
    """Be the victim's process."""
    os.dup2(os.open(log, os.O_WRONLY), sys.stderr.fileno())
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    CountingSockets(total)
    anyio.run(
        echo,
        domain,
        test,
        backend_options={"loop_factory": lambda: asyncio.SelectorEventLoop(Meter(orders))},
    )
