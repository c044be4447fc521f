"""The brokers of a run, by the names that they have in their cluster."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from tests.support.nats_server import NatsServer, nats_cluster, nats_server


class Servers(NamedTuple):
    """Processes of nats-server, which keep their ports and their data when they start again."""

    by_name: Mapping[str, NatsServer]

    @property
    def hosts(self) -> str:
        """The addresses of all servers, as a URL of a fleet lists them."""
        return ",".join(one.address for one in self.by_name.values())

    @property
    def urls(self) -> list[str]:
        """The addresses of all servers, as NATS writes them."""
        return [f"nats://{one.address}" for one in self.by_name.values()]


@contextmanager
def servers(count: int) -> Iterator[Servers]:
    """Run one server, or a cluster, while the block lasts."""
    if count == 1:
        with nats_server() as one:
            yield Servers({"broker0": one})
    else:
        with nats_cluster(count) as all_of_them:
            yield Servers({f"broker{number}": one for number, one in enumerate(all_of_them)})
