"""Limits of what peers can make a participant hold, and counts of what it has left out."""

from __future__ import annotations

from msgspec import Struct

MIB = 2**20


class RtpsLimits(Struct, frozen=True, kw_only=True):
    """The most that a participant holds. What is beyond a limit is dropped and counted."""

    participants: int = 512
    """Other participants."""
    participants_of_host: int = 128
    """Other participants of one host; more than its ports in one domain are for."""
    hosts: int = 1_024
    """Hosts whose new participants are counted, to take only so many of each at a time."""
    endpoints: int = 16_384
    """Endpoints of all other participants together."""
    endpoints_of_one: int = 2_048
    """Endpoints of one other participant."""
    matches_of_one: int = 64
    """Endpoints of one other participant that one endpoint of this one is matched with."""
    sample: int = 16 * MIB
    """Bytes of one received sample."""
    held: int = 64 * MIB
    """Bytes of received samples that wait for earlier ones, of all readers together."""
    incomplete: int = 64 * MIB
    """Bytes of received samples that lack fragments, of all readers together."""
    early_heartbeats: int = 1_024
    """Heartbeats of writers that discovery has not told of yet."""
    early_heartbeats_of_one: int = 128
    """Such heartbeats of one other participant."""
    history: int = 64 * MIB
    """Bytes of samples that one writer keeps."""
    history_samples: int = 10_000
    """Samples that one writer keeps."""
    outbox: int = 65_536
    """Submessages that wait to be sent."""


class RtpsCounters(Struct):
    """Counts of what a participant has received and left out."""

    datagrams: int = 0
    """Datagrams received."""
    own: int = 0
    """Those of this participant itself, which multicast brings back."""
    of_other_domains: int = 0
    """Announcements of participants in another domain, or with a domain tag."""
    invalid: int = 0
    """Datagrams that broke the rules or limits of the wire format, or of discovery."""
    over_limit: int = 0
    """Samples, fragments, participants, endpoints and matches beyond a limit."""
    unsent: int = 0
    """Submessages that did not fit into the outbox."""
    withheld: int = 0
    """Datagrams for participants that have not shown yet that they receive anything."""
    forged: int = 0
    """Submessages in the name of a participant that is at another host."""


class ByteAccount:
    """Bytes that are held, up to a limit."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.held = 0
        """Bytes that are held now."""

    def take(self, size: int) -> bool:
        """Hold so many bytes more; return False, and hold none, if that exceeds the limit."""
        if self.held + size > self._limit:
            return False
        self.held += size
        return True

    def free(self, size: int) -> None:
        """Hold so many bytes less."""
        self.held -= size
