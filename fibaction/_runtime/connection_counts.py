"""`CONNECTIONS`: what the wire servers of this process count, for metrics.

Connections belong to transports, which no watcher of an action sees. A process has one of these, as
it has one set of metrics.
"""

from __future__ import annotations

from collections import Counter


class ConnectionCounts:
    """The connections of clients, and what was wrong with them."""

    def __init__(self) -> None:
        self.open = 0
        """Connections that are open now."""
        self.errors: Counter[str] = Counter()
        """Connections that the server has ended because of an error, by the name of its class."""


CONNECTIONS = ConnectionCounts()
"""The counts of this process."""
