"""Limits of what peers can make a participant hold and send, and counts of what it has left out.

*What it sends.* UDP does not show that a datagram comes from the address that it says, and RTPS has
no handshake. So, as QUIC does, a participant is sent at most three times the bytes that came in its
name, until a datagram for this very participant has come from where it says it is: whoever sends
that has received something, because identifiers of participants are random.

Later, lost samples are repeated for it as far as its budget goes. It grows with what is written for
it, since a repair is needed for something that was lost, and slowly with the time.
"""

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


UNPROVEN_FACTOR = 3
"""Bytes that are sent to a participant for each byte that came in its name."""
REPAIR_FACTOR = 2
"""Bytes that are repeated for each byte that is written."""
REPAIRS_AT_ONCE = 4 * MIB
"""Bytes that are repeated for a participant for which nothing is written, at once."""
REPAIRS_PER_SECOND = MIB
MOST_REPAIRS = 64 * MIB
"""The largest budget."""


class PeerBudget:
    """The bytes that may be sent to one other participant."""

    def __init__(self, now: float) -> None:
        self._sendable = 0
        self._repairs = float(REPAIRS_AT_ONCE)
        self._at = now
        self.is_proven = False
        """True if it has shown that it receives what it is sent."""

    def earn(self, size: int) -> None:
        """Note that so many bytes came in its name."""
        self._sendable += UNPROVEN_FACTOR * size

    def may_send(self, size: int) -> bool:
        """Return whether it may be sent so many bytes, and count them."""
        if self.is_proven:
            return True
        if size > self._sendable:
            return False
        self._sendable -= size
        return True

    def write(self, size: int) -> None:
        """Note that so many bytes are written for it."""
        self._repairs = min(self._repairs + REPAIR_FACTOR * size, MOST_REPAIRS)

    def may_repair(self, size: int, now: float) -> bool:
        """Return whether so many bytes may be repeated now, and count them.

        One sample of any size may be repeated if anything is left.
        """
        if self._repairs < REPAIRS_AT_ONCE:
            earned = max(0.0, now - self._at) * REPAIRS_PER_SECOND
            self._repairs = min(self._repairs + earned, REPAIRS_AT_ONCE)
        self._at = now
        if self._repairs <= 0:
            return False
        self._repairs -= size
        return True


class HostRates:
    """The number of new participants of each host that are taken: many at once, then some for each
    second.
    """

    def __init__(self, at_once: int, per_second: float, hosts: int) -> None:
        self._at_once = at_once
        self._per_second = per_second
        self._most_hosts = hosts
        self._hosts: dict[str, tuple[float, float]] = {}

    def take(self, host: str, now: float) -> bool:
        """Take a new participant of a host; return False if there were too many."""
        left = self._left(host, now)
        if left < 1 or (host not in self._hosts and not self._has_room(now)):
            return False
        self._hosts[host] = left - 1, now
        return True

    def _left(self, host: str, now: float) -> float:
        left, at = self._hosts.get(host, (self._at_once, now))
        return min(left + (now - at) * self._per_second, self._at_once)

    def _has_room(self, now: float) -> bool:
        """Return whether another host can be noted; forget those that may begin again in full."""
        if len(self._hosts) >= self._most_hosts:
            for host in [each for each in self._hosts if self._left(each, now) >= self._at_once]:
                del self._hosts[host]
        return len(self._hosts) < self._most_hosts
