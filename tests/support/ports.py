"""Free ports of this machine, for servers that begin later, or again."""

from __future__ import annotations

import socket
from random import SystemRandom

FIRST, LAST = 10_000, 32_767
"""Below the ports that Linux gives to connections: a client that tries to connect again and again
where no server listens would get its own port there one day, and meet itself."""

_chance = SystemRandom()  # processes that were forked choose apart


def free_port() -> int:
    """Return a port where no server listens, nor will one that does not ask for this port."""
    while True:
        port = _chance.randint(FIRST, LAST)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return port
