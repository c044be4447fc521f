"""A network that loses, delays, repeats and reorders the datagrams of this process, on asyncio."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from random import Random
from typing import Any

import anyio
import msgspec
import pytest

from fibaction.border.event_loop import asyncio_loop
from fibaction_transports.rtps import network
from fibaction_transports.rtps.messages.ids import Address


class Weather(msgspec.Struct, frozen=True):
    """What happens to datagrams, each way between two ends."""

    loss: float
    """The share that is lost."""
    late: float = 0.1
    """The share that is late, and so may be overtaken."""
    delay: float = 0.005
    """Seconds by which they are late, at most."""
    repeats: float = 0.05
    """The share that arrives twice."""


class BadNetwork(network.ParticipantNetwork):
    """A participant in such weather."""

    weather: Weather
    random: Random
    is_bad_inwards: bool
    """True if what arrives suffers, too: the other end is in another process, and a datagram of it
    has not suffered yet."""

    def __init__(self, participant: Any, sockets: Any, *rest: Any) -> None:
        super().__init__(participant, sockets, *rest)
        self._is_open = True
        send, receive = sockets.send, participant.receive

        def send_some(datagram: bytes, address: Address) -> None:
            self._suffer(lambda: send(datagram, address))

        def receive_some(datagram: bytes, address: Address, now: float) -> None:
            def arrive() -> None:
                receive(datagram, address, anyio.current_time())
                self.settle()

            self._suffer(arrive)

        sockets.send = send_some
        if self.is_bad_inwards:
            participant.receive = receive_some

    async def close(self) -> None:
        self._is_open = False
        await super().close()

    def _suffer(self, arrive: Callable[[], None]) -> None:
        random, weather = self.random, self.weather
        if random.random() < weather.loss:
            return
        for _ in range(1 + (random.random() < weather.repeats)):
            if random.random() < weather.late:
                delay = random.random() * weather.delay
                asyncio_loop().call_later(delay, self._arrive_late, arrive)
            else:
                arrive()

    def _arrive_late(self, arrive: Callable[[], None]) -> None:
        if self._is_open:
            arrive()


@contextmanager
def bad_network(weather: Weather, seed: int, *, inwards: bool) -> Iterator[None]:
    """Let the participants that this process opens have such a network, by a seed."""
    members = {"weather": weather, "random": Random(seed), "is_bad_inwards": inwards}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "ParticipantNetwork", type("Bad", (BadNetwork,), members))
        yield
