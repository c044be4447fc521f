"""A network in memory is as good, and as bad, as a real one."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from tests.simulation import loop as virtual
from tests.simulation.network import Line, Network
from tests.simulation.streams import SimulatedStream, Weather


def over_a_line(
    main: Callable[[Network, Line, SimulatedStream, SimulatedStream], Awaitable[None]],
    weather: Weather | None = None,
) -> None:
    """Run a test between the two ends of a connection."""
    loop = virtual.VirtualLoop()

    async def connected() -> None:
        network = Network(loop, random.Random(1), lambda _: None)
        line = network.line("client", weather or Weather())
        listening = network.host.listen()
        near = await line.dial()
        far = await listening.accept()
        with anyio.fail_after(1000):
            await main(network, line, near, far)
        await near.aclose()
        await far.aclose()
        assert network.open_ends() == []

    virtual.run(connected, loop)


def test_a_connection_that_is_cut_loses_what_is_under_way() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        await near.send(bytes(1000))
        line.cut("reset")
        received = b""
        with pytest.raises(anyio.BrokenResourceError):
            while True:
                received += await far.receive()
        assert len(received) < 1000
        with pytest.raises(anyio.BrokenResourceError):
            await near.receive()
        with pytest.raises(anyio.BrokenResourceError):
            await near.send(b"x")

    over_a_line(main, Weather(latency=0.001, pieces=9))


def test_a_silent_end_tells_nobody() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.cut("silence")
        await near.send(b"lost")
        with anyio.move_on_after(500) as scope:
            await far.receive()
        assert scope.cancelled_caught

    over_a_line(main)


def test_half_of_a_connection_can_end() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        line.half_close("up")
        with pytest.raises(anyio.EndOfStream):
            await far.receive()
        await far.send(b"still here")
        assert await near.receive() == b"still here"

    over_a_line(main)


def test_a_frozen_line_goes_on_later() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        begun = anyio.current_time()
        line.freeze(30, "up")
        await near.send(b"late")
        assert await far.receive() == b"late"
        assert anyio.current_time() - begun >= 30

    over_a_line(main)


def test_a_host_that_dies_breaks_its_ends_at_once_and_listens_no_more() -> None:
    async def main(network: Network, line: Line, near: Any, far: Any) -> None:
        network.host.die("silence")
        with pytest.raises(anyio.BrokenResourceError):
            await far.receive()
        with pytest.raises(ConnectionRefusedError):
            await line.dial()

    over_a_line(main)
