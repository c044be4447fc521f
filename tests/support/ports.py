"""Free ports of this machine, for servers that begin later, or again."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from itertools import cycle, islice
from random import SystemRandom

BLOCK = 512
"""Ports of one process."""
BLOCKS = range(10_000, 32_767 - BLOCK, BLOCK)
"""The first ports of the blocks. They are below those that Linux gives to connections: a client
that tries to connect again and again where no server listens would get its own port there one day,
and meet itself."""

_chance = SystemRandom()  # processes that were forked choose apart


def free_port() -> int:
    """Return a port where no server listens, nor will one that does not ask for this port.

    No other process that asks here gets it, also while its server is away.
    """
    for port in islice(_own_ports, BLOCK):
        with socket.socket() as probe:
            # As servers bind: Linux keeps the port of a connection that was closed for a minute,
            # and a process that is fast comes round before.
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if _can_bind(probe, port):
                return port
    raise AssertionError(f"servers listen at all {BLOCK} ports of this process")


def _ports() -> Iterator[int]:
    """Yield the ports of a block in turn, over and over.

    The block belongs to the process that has bound its first port, which it does until it ends.
    """
    while True:
        with socket.socket() as claim:
            first = _chance.choice(BLOCKS)
            if _can_bind(claim, first):
                yield from cycle(range(first + 1, first + BLOCK))


def _can_bind(end: socket.socket, port: int) -> bool:
    """Bind a socket to a port if that is free."""
    try:
        end.bind(("127.0.0.1", port))
    except OSError:
        return False
    return True


_own_ports = _ports()
