"""`Addresses`: the connections of each address, and which connection makes room for a newcomer.

A server that is full ends a connection for each newcomer, of those that say nothing, do nothing or
do not read: of the address that has the most connections, since that is where a flood comes from.
So the clients of other addresses get in during a flood. Clients behind one proxy have one address,
and share this fate, but are not kept out: what is ended has nothing to lose.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from functools import lru_cache
from ipaddress import IPv6Address, ip_address
from typing import NamedTuple

SITE = 64
"""Bits of an IPv6 address that name a site: a host with one address there has all of them."""


class Candidate(NamedTuple):
    """A connection that may be ended for a newcomer."""

    address: str
    """Its address; empty if it has none."""
    end: Callable[[], None]
    """Ends it."""


class Addresses:
    """The connections of each address."""

    def __init__(self, most: int | None) -> None:
        """Let each address have so many connections; None for any number."""
        self.most = most
        """The most connections of one address; None for any number."""
        self._counts: Counter[str] = Counter()

    def enter(self, peer: str) -> str:
        """Count one more connection of a peer, and return its address."""
        address = address_of(peer)
        self._counts[address] += 1
        return address

    def leave(self, address: str) -> None:
        """Count one connection less."""
        self._counts[address] -= 1
        if not self._counts[address]:
            del self._counts[address]

    def has_too_many(self, address: str) -> bool:
        """Return whether an address has more connections than it may have."""
        return self.most is not None and bool(address) and self._counts[address] > self.most

    def make_room(self, candidates: Iterable[Candidate], address: str = "") -> bool:
        """End the first candidate of the address that has the most connections, or of the given
        one; return whether there was one.
        """
        chosen = max(
            (one for one in candidates if address in ("", one.address)),
            key=lambda one: self._counts[one.address],
            default=None,
        )
        if chosen is not None:
            chosen.end()
        return chosen is not None


@lru_cache(maxsize=1000)
def address_of(peer: str) -> str:
    """Return what is counted of a peer such as `127.0.0.1:51234`: its address, of an IPv6 address
    the site; empty if it has none.
    """
    try:
        address = ip_address(peer.rpartition(":")[0])
    except ValueError:  # a local process, for example
        return ""
    if not isinstance(address, IPv6Address):
        return str(address)
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return f"{IPv6Address(int(address) >> SITE << SITE)}/{SITE}"
